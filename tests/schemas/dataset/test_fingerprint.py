"""What two stacks differ in, and what to do about it."""

import pytest

from schemas.dataset.shard import Fingerprint

MINE = Fingerprint(
    canary="c", code="d", libraries={"numpy": "2.4.6"}, simd="X86_V2 X86_V3", renderer="llvmpipe, 256 bits"
)


@pytest.mark.parametrize(
    ("change", "difference", "remedy"),
    [
        ({"code": "e"}, "code: d, e", "install the same wheel"),
        ({"libraries": {"numpy": "2.4.5"}}, "numpy: 2.4.6, 2.4.5", "requirements.lock"),
        ({"renderer": "llvmpipe, 512 bits"}, "renderer: llvmpipe, 256 bits, llvmpipe, 512 bits", "libgl1-mesa-dri"),
        ({"simd": "X86_V2"}, "simd: X86_V2 X86_V3, X86_V2", "NPY_DISABLE_CPU_FEATURES"),
        ({"maths": "m"}, "maths: , m", "GLIBC_TUNABLES"),
        ({"canary": "x"}, "canary: c, x", "machines of one kind"),
    ],
)
def test_each_difference_has_its_remedy(change, difference, remedy):
    other = MINE.model_copy(update=change)
    assert MINE.differences(other) == [difference]
    assert remedy in MINE.remedies(other)
    assert MINE.digest != other.digest


def test_what_can_be_installed_is_told_before_what_cannot():
    other = MINE.model_copy(update={"canary": "x", "code": "e", "simd": "none"})
    assert "install the same wheel" in MINE.remedies(other)
