import numpy as np
import pytest

from schemas.job.captures import Estimation
from tests.workers.capture.photographs import KINECT, hand_held
from tests.workers.capture.poses.scenes import LENS, PINHOLE, errors, observe
from workers.capture.poses.markers import fit_markers, focal_lengths, is_ambiguous, measured_corner_px, planar_poses
from workers.geometry.camera import look_at

SPEC = Estimation()


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_26_markers_at_a_fifth_of_a_pixel_give_a_fifth_of_a_millimetre(camera):
    """The arithmetic of the article's warning: 104 corners at 0.2 px and 0.8 m give 0.2 mm and 0.015 degrees."""
    rng = np.random.default_rng(0)
    found = []
    for T in hand_held(rng, 40, distance_m=(0.8, 0.8), inclination_rad=(0.8, 1.1)):
        view = observe(T, rng, camera=camera, ids=rng.choice(35, 26, replace=False))
        found.append(errors(fit_markers(view, camera, SPEC).fit.T_board_cam, T))
    mm, degrees = np.sqrt(np.mean(np.square(found), axis=0) / 3)  # an axis
    assert 0.1 < mm < 0.3
    assert 0.008 < degrees < 0.025


def test_the_covariance_tells_the_errors():
    rng = np.random.default_rng(1)
    squares = []
    for T in hand_held(rng, 100):
        fit = fit_markers(observe(T, rng, ids=range(9, 26)), PINHOLE, SPEC).fit
        d = T[:3, :3].T @ (fit.T_board_cam[:3, 3] - T[:3, 3])
        squares.append(d @ np.linalg.solve(0.04 * np.linalg.inv(fit.information)[:3, :3], d))
    assert 2.2 < np.mean(squares) < 4.0  # chi-square of three


def test_one_small_marker_is_ambiguous_and_a_whole_board_is_not():
    rng = np.random.default_rng(2)
    one, all_ = [], []
    for T in hand_held(rng, 30, distance_m=(2.5, 2.5)):
        one.append(is_ambiguous(fit_markers(observe(T, rng, ids=[17]), PINHOLE, SPEC), 0.2))
        all_.append(is_ambiguous(fit_markers(observe(T, rng), PINHOLE, SPEC), 0.2))
    assert np.mean(one) > 0.5 and not any(all_)


def test_of_two_poses_that_look_alike_one_is_near_the_truth():
    rng = np.random.default_rng(3)
    for T in hand_held(rng, 10, distance_m=(1.2, 1.2)):
        view = observe(T, rng, ids=[17])
        near = min(errors(start, T)[1] for start in planar_poses(view.corners))
        assert near < 10  # degrees; before refinement


def test_a_frontal_board_is_no_trap():
    rng = np.random.default_rng(4)
    for _ in range(10):
        T = look_at(np.array([*rng.normal(0, 0.01, 2), 0.8]), np.zeros(3))
        found = fit_markers(observe(T, rng), PINHOLE, SPEC)
        mm, degrees = errors(found.fit.T_board_cam, T)
        assert mm < 2 and degrees < 0.15


def test_a_mirrored_layout_is_no_pose_from_above():
    rng = np.random.default_rng(5)
    for T in hand_held(rng, 5):
        view = observe(T, rng, corner_px=0)
        mirrored = view.corners.board * np.array([-1.0, 1, 1])
        corners = type(view.corners)(mirrored, *list(vars(view.corners).values())[1:])
        found = fit_markers(type(view)(0, corners), PINHOLE, SPEC)
        assert found.fit is None and "mirrored" in found.reason


def test_too_few_markers_are_named_with_their_setting():
    view = observe(hand_held(np.random.default_rng(6), 1)[0], np.random.default_rng(6), ids=[3, 4])
    found = fit_markers(view, PINHOLE, Estimation(min_markers=3))
    assert found.fit is None and found.reason == "2 markers of the board found, and min_markers is 3"


@pytest.mark.parametrize("corner_px", [0.1, 0.2, 0.5])
def test_the_sigma_of_a_corner_is_measured(corner_px):
    rng = np.random.default_rng(7)
    poses = [fit_markers(observe(T, rng, corner_px=corner_px), PINHOLE, SPEC) for T in hand_held(rng, 10)]
    assert measured_corner_px(poses, SPEC) == pytest.approx(corner_px, rel=0.1)
    assert measured_corner_px([], SPEC) == SPEC.corner_px
    assert focal_lengths(PINHOLE)[0] == KINECT.fx
