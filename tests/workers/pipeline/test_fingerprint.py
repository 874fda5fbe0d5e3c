"""The fingerprint of this stack."""

import numpy as np

from workers.pipeline.code import code_digest
from workers.pipeline.fingerprint import TIER_LIBRARIES, numpy_simd, take_fingerprint
from workers.render.raster.gbuffer import shared_renderer


def test_the_same_stack_has_the_same_fingerprint_and_names_what_the_bytes_depend_on():
    first, second = (take_fingerprint(shared_renderer(), "raster") for _ in range(2))
    assert first == second and first.digest == second.digest
    assert first.libraries["numpy"] == np.__version__
    assert first.code == code_digest() and len(first.canary) == 64
    assert first.simd == numpy_simd() and first.renderer == shared_renderer().name
    assert TIER_LIBRARIES["pathtraced"][0] not in first.libraries
