import dataclasses

import numpy as np
import pytest

from schemas.capture import DepthCorrection
from tests.workers.capture.photographs import hand_held
from tests.workers.capture.poses.scenes import evidence_of, observe
from workers.capture.poses.markers import moved
from workers.capture.poses.observation import Patches
from workers.capture.poses.verdict import Judged, corrected_points, judge
from workers.geometry.frames import invert, transform, translation

NONE = DepthCorrection()
T = hand_held(np.random.default_rng(0), 1)[0]
VIEW = observe(T, np.random.default_rng(0))
EVIDENCE = evidence_of([VIEW])


def patches_on_board(lift_m=0.0):
    """Nine patches of the board whose depth says that it lies `lift_m` higher."""
    x, y = np.meshgrid([-0.2, 0, 0.2], [-0.1, 0, 0.1])
    p = transform(invert(T), np.column_stack([x.ravel(), y.ravel(), np.full(9, lift_m)]))
    return Patches(p, p / p[:, 2:], np.zeros((9, 3)), np.full(9, 50), np.full(9, 0.001))


def test_a_good_view_is_used_and_its_depth_is_measured_against_the_board():
    view = judge(dataclasses.replace(VIEW, board_patches=patches_on_board(0.004)), Judged(T), EVIDENCE, NONE)
    assert view.status == "used" and view.depth_mm == pytest.approx(4.0)
    assert view.reprojection_px < 0.3


def test_a_view_that_does_not_fit_is_flagged_with_the_number():
    off = moved(T, np.array([0, 0, 0, 0, 0.01, 0]))
    view = judge(VIEW, Judged(off), EVIDENCE, NONE)
    assert view.status == "flagged" and "above max_reprojection_px 3" in view.reasons[0]
    assert f"{view.reprojection_px:.2f} px" in view.reasons[0]


def test_an_uncertain_pose_is_flagged_with_its_sigma():
    covariance = np.diag([1e-8] * 3 + [0.03**2] * 3)
    view = judge(VIEW, Judged(T, covariance), EVIDENCE, NONE)
    assert len(view.reasons) == 1 and "the pose is uncertain: 0.1 mm, 1.7" in view.reasons[0]


def test_a_view_that_fits_worse_than_others_is_less_certain():
    rng = np.random.default_rng(3)
    poor = observe(T, rng, corner_px=0.6)
    covariance = np.diag([1e-8] * 6)
    told = judge(poor, Judged(T, covariance), EVIDENCE, NONE).covariance
    assert told[0, 0] / 1e-8 == pytest.approx((0.6 / EVIDENCE.corner_px) ** 2, rel=0.3)


@pytest.mark.parametrize("pose", [None, np.full((4, 4), np.nan)])
def test_no_pose_is_refused_and_never_nan(pose):
    view = judge(VIEW, Judged(pose), EVIDENCE, NONE)
    assert view.status == "refused" and view.T_board_cam is None and view.reasons


def test_the_correction_is_scale_then_offset_then_the_place_of_the_depth_camera():
    patches = patches_on_board()
    depth = DepthCorrection(0.01, 1.02, translation(0.1, 0, 0))
    expected = patches.ray_z * 1.02 + 0.01 * patches.ray + np.array([0.1, 0, 0])
    assert corrected_points(patches, depth) == pytest.approx(expected)
