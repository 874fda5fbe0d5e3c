"""The environment that bytes depend on, and what importing descriptions of data must not load."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

from schemas.environment import FOR_SPEED, ON_X86_64_V3, STACK_ENVIRONMENT, X86_64_V3, settings_to_change

ROOT = Path(__file__).resolve().parents[2]
RIGHT = {**STACK_ENVIRONMENT, **FOR_SPEED}


def test_settings_are_changed_only_where_they_must_and_only_for_a_processor_that_has_all_that_they_use():
    assert settings_to_change(RIGHT, frozenset()) == {}
    assert settings_to_change({**RIGHT, "LP_NUM_THREADS": "4"}, frozenset()) == {"LP_NUM_THREADS": "0"}
    assert settings_to_change(RIGHT, X86_64_V3 | {"sse2"}) == dict(ON_X86_64_V3)
    for flag in X86_64_V3:
        assert settings_to_change(RIGHT, X86_64_V3 - {flag}) == {}
    assert settings_to_change(STACK_ENVIRONMENT, frozenset()) == dict(FOR_SPEED)
    assert settings_to_change({**STACK_ENVIRONMENT, "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2"}, frozenset()) == {}


def python(asks: str, *options: str, **environ: str) -> str:
    """What a fresh interpreter prints; nothing on standard error."""
    run = [sys.executable, *options, "-c", asks]
    done = subprocess.run(run, cwd=ROOT, env={**os.environ, **environ}, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout


def test_numba_compiles_for_the_level_and_not_for_the_processor():
    asks = "from numba.core.registry import cpu_target as c; print(c.target_context.codegen().magic_tuple()[1:])"
    assert ast.literal_eval(python(asks, **ON_X86_64_V3)) == ("x86-64-v3", "+avx2")


def test_numpy_runs_without_avx512_and_does_not_complain():
    asks = (
        "import numpy._core._multiarray_umath as m; "
        "print({name: m.__cpu_features__[name] for name in m.__cpu_dispatch__ if '512' in name or name == 'X86_V4'})"
    )
    groups = ast.literal_eval(python(asks, "-W", "error", **STACK_ENVIRONMENT))
    assert set(groups) == set(STACK_ENVIRONMENT["NPY_DISABLE_CPU_FEATURES"].split(","))  # numpy knows no others
    assert not any(groups.values())


def test_the_image_sets_the_same_environment():
    lines = (ROOT / "deploy" / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
    pairs = [pair for line in lines if line.startswith("ENV ") for pair in re.findall(r"(\w+)=(\S+)", line)]
    assert {name: value for name, value in pairs if name in RIGHT} == RIGHT
