import ast
import os
import re
import subprocess
import sys
from pathlib import Path

from schemas.environment import STACK_ENVIRONMENT, WITH_AVX2, settings_to_change

ROOT = Path(__file__).resolve().parents[2]


def test_nothing_changes_where_the_environment_is_right_already():
    assert settings_to_change(STACK_ENVIRONMENT, frozenset()) == {}
    assert settings_to_change({**STACK_ENVIRONMENT, "LP_NUM_THREADS": "4"}, frozenset()) == {"LP_NUM_THREADS": "0"}


def test_openblas_is_told_its_kernels_only_where_the_processor_has_them():
    assert settings_to_change(STACK_ENVIRONMENT, frozenset({"avx2"})) == dict(WITH_AVX2)


def test_numpy_runs_without_avx512_and_does_not_complain():
    asks = (
        "import numpy._core._multiarray_umath as m; "
        "print({name: m.__cpu_features__[name] for name in m.__cpu_dispatch__ if '512' in name or name == 'X86_V4'})"
    )
    environ = {**os.environ, **STACK_ENVIRONMENT}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", asks], env=environ, capture_output=True, text=True, check=True
    )
    groups = ast.literal_eval(done.stdout)
    assert set(groups) == set(STACK_ENVIRONMENT["NPY_DISABLE_CPU_FEATURES"].split(","))  # numpy knows no others
    assert not any(groups.values())
    assert done.stderr == ""


def test_the_image_sets_the_same_environment():
    lines = (ROOT / "deploy" / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
    pairs = [pair for line in lines if line.startswith("ENV ") for pair in re.findall(r"(\w+)=(\S+)", line)]
    assert {name: value for name, value in pairs if name in STACK_ENVIRONMENT} == dict(STACK_ENVIRONMENT)
