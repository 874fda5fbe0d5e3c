"""The fingerprint of this stack."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from services.run.worker_entry import processor_flags
from workers.render.raster.gbuffer import shared_renderer
from workers.shard.code import code_digest
from workers.shard.fingerprint import TIER_LIBRARIES, maths_digest, numpy_simd, take_fingerprint


def test_the_same_stack_has_the_same_fingerprint_and_names_what_the_bytes_depend_on():
    first, second = (take_fingerprint(shared_renderer(), "raster") for _ in range(2))
    assert first == second and first.digest == second.digest
    assert first.libraries["numpy"] == np.__version__
    assert first.code == code_digest() and len(first.canary) == 64
    assert first.simd == numpy_simd() and first.renderer == shared_renderer().name
    assert TIER_LIBRARIES["pathtraced"][0] not in first.libraries


def maths_with(tunables: str) -> str:
    """The digest of the maths of a process whose C library is told to see a smaller processor."""
    ask = [sys.executable, "-c", "from workers.shard.fingerprint import maths_digest; print(maths_digest())"]
    environ = {**os.environ, "GLIBC_TUNABLES": tunables}
    root = Path(__file__).resolve().parents[3]
    return subprocess.run(ask, cwd=root, env=environ, capture_output=True, text=True, check=True).stdout.strip()


def test_a_c_library_that_multiplies_and_adds_in_two_steps_is_another_stack():
    if "fma" not in processor_flags():
        pytest.skip("this processor has no fused multiplication")
    assert maths_with("") == maths_digest()
    assert maths_with("glibc.cpu.hwcaps=-FMA,-AVX2") != maths_digest()


def test_a_c_library_that_sees_no_avx512_is_the_same_stack():
    assert maths_with("glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ,-AVX512CD") == maths_digest()
