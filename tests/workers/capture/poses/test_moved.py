import numpy as np
import pytest

from tests.workers.capture.poses.captures import FINER, Virtual, make
from workers.capture.poses.estimates import moved_after
from workers.capture.poses.joint import gather
from workers.capture.poses.observation import no_patches
from workers.capture.poses.terms import Shared
from workers.geometry.frames import translation

TRUTH, EVIDENCE = make(Virtual(views=14, camera=FINER))
PATCHES, VIEW = gather([o.object_patches for o in EVIDENCE.observations])


def poses(shift_m, first):
    """Poses by which the object seems to move on the board by a shift from a view on."""
    return np.stack([(translation(*shift_m) if n >= first else np.eye(4)) @ T for n, T in enumerate(TRUTH)])


def test_a_still_object_did_not_move():
    assert moved_after(PATCHES, VIEW, poses((0, 0, 0), 0), Shared()) is None


@pytest.mark.parametrize("first", [4, 7, 10])
@pytest.mark.parametrize("shift_m", [(0.03, 0.01, 0), (-0.02, 0.02, 0)])
def test_a_move_is_found_with_its_view_and_size(first, shift_m):
    last, apart_m = moved_after(PATCHES, VIEW, poses(shift_m, first), Shared())
    assert abs(last - (first - 1)) <= 5  # views between that see other faces cannot tell on which side they are
    assert 0.6 * np.linalg.norm(shift_m) < apart_m < 1.2 * np.linalg.norm(shift_m)


def test_without_depth_nothing_is_said():
    assert moved_after(no_patches(), np.zeros(0, np.int64), np.stack(TRUTH), Shared()) is None
