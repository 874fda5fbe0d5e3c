"""What one view tells: rays, corners, patches of depth, its pose from markers, and the verdict on it."""

import dataclasses

import numpy as np
import pytest

from schemas.capture import CaptureCamera, DepthCorrection, Detection
from schemas.job.captures import Board, Estimation
from tests.workers.capture.drawn import (
    BOX,
    HALF,
    KINECT,
    LENS,
    PINHOLE,
    DepthErrors,
    errors,
    evidence_of,
    hand_held,
    measured_depth,
    observe,
    project,
)
from workers.capture.board import first_poses, marker_corners
from workers.capture.poses.markers import (
    Judged,
    fit_markers,
    fit_pose,
    judge,
)
from workers.capture.poses.observation import (
    MOST,
    Observation,
    Patches,
    Setup,
    board_patches,
    fit_patches,
    no_patches,
    object_patches,
)
from workers.capture.poses.terms import moved
from workers.geometry.camera import look_at
from workers.geometry.frames import invert, transform, translation

SPEC = Estimation()
FOCAL = np.array([KINECT.fx, KINECT.fy])
SETUP = Setup(CaptureCamera(HALF, np.zeros(8)), Board(), SPEC)
T0 = hand_held(np.random.default_rng(0), 1)[0]


# ---------------------------------------------------------------------------------------------- patches of depth


def test_patches_of_an_exact_board_lie_on_its_plane_with_its_normal():
    for seed in range(2):
        rng = np.random.default_rng(seed)
        T, ids = hand_held(rng, 1)[0], np.arange(35)
        pixels = project(marker_corners(Board()).reshape(-1, 3), T, SETUP.camera).reshape(-1, 4, 2)
        depth = measured_depth(T, HALF, DepthErrors(), rng, box=False)
        found = board_patches(depth, Detection(0, ids, pixels), Board(), SETUP.camera)
        assert len(found) == 35 + 30 + 28  # markers, gaps beside and below them
        assert np.abs(transform(T, found.ray_z)[:, 2]).max() < 3e-4  # depth is stored in millimetres
        assert (found.normal @ T[:3, :3].T)[:, 2].min() > 0.995
        assert found.ray[:, 2] == pytest.approx(1.0)


def test_averages_are_as_much_better_as_there_are_samples():
    rng = np.random.default_rng(3)
    rays = rng.uniform(-0.02, 0.02, (400, 100, 2)) + np.array([0.2, 0.1])
    z = 1.0 / (0.3 * rays[..., 0] - 0.2 * rays[..., 1] + 1.2)
    noisy, exact = fit_patches(rays, z + rng.normal(0, 0.003, z.shape)), fit_patches(rays, z)
    assert exact.normal == pytest.approx(np.tile(-np.array([0.3, -0.2, 1.2]) / np.sqrt(1.57), (400, 1)), abs=1e-6)
    assert np.std(noisy.ray_z[:, 2] - exact.ray_z[:, 2]) == pytest.approx(0.0003, rel=0.15)
    assert np.median(noisy.sigma_m) == pytest.approx(0.003, rel=0.1)


def test_flying_pixels_and_missing_ones_do_not_move_a_patch_and_too_little_depth_makes_none():
    rng = np.random.default_rng(4)
    rays = rng.uniform(-0.02, 0.02, (50, 100, 2))
    z = 1.0 / (0.3 * rays[..., 0] + 1.2) + rng.normal(0, 0.001, (50, 100))
    z[:, :10] += 0.2
    z[:, 10:40] = 0
    spoilt = fit_patches(rays, z)
    assert len(spoilt) == 50 and np.isfinite(spoilt.normal).all()
    assert np.abs((spoilt.ray_z * np.array([0.3, 0, 1.2])).sum(axis=1) - 1).max() < 2e-3
    few = np.ones((3, 100))
    few[0, 20:] = few[1] = 0
    assert len(fit_patches(rays[:3], few)) == 1 and len(fit_patches(rays[:0], z[:0])) == 0


def test_the_objects_patches_lie_on_the_faces_of_the_box_and_face_the_camera():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        T = hand_held(rng, 1)[0]
        depth = measured_depth(T, HALF, DepthErrors(sigma_m=0.001), rng)
        found = object_patches(depth, T, no_patches(), SETUP)
        points = transform(T, found.ray_z)
        beyond = np.maximum(BOX[0] - points, points - BOX[1]).max(axis=1)
        assert 30 < len(found) <= MOST
        assert np.median(np.abs(beyond)) < 5e-4 and np.abs(beyond).max() < 6e-3
        assert ((found.normal * found.ray).sum(axis=1) < 0).all()
    empty = measured_depth(T0, HALF, DepthErrors(sigma_m=0.002), np.random.default_rng(0), box=False)
    away = T0.copy()
    away[:3, :3] = T0[:3, :3] @ np.diag([1.0, -1, -1])
    for depth, T in ((empty, T0), (np.zeros_like(empty), T0), (np.full_like(empty, 700), away)):
        assert len(object_patches(depth, T, no_patches(), SETUP)) == 0


# ---------------------------------------------------------------------------------------------- motions and fits


def test_a_fit_is_the_truth_through_a_lens_and_wrong_corners_move_it_by_little():
    rng = np.random.default_rng(1)
    for T in hand_held(rng, 5):
        start = moved(T, rng.normal(0, 0.02, 6))
        exact = observe(T, rng, corner_px=0, camera=LENS).corners
        assert max(errors(fit_pose(start, exact, PINHOLE).T_board_cam, T)) < 1e-3
        seen = observe(T, rng).corners
        wrong = seen.rays.copy()
        wrong[rng.choice(len(wrong), len(wrong) // 20, replace=False)] += 30 / 912
        clean = fit_pose(T, seen, PINHOLE)
        spoilt = fit_pose(start, dataclasses.replace(seen, rays=wrong), PINHOLE)
        mm, degrees = errors(spoilt.T_board_cam, clean.T_board_cam)
        assert mm < 0.3 and degrees < 0.03
    turned = moved(T0, np.array([0, 0, 0, 0, np.pi * 0.99, 0]))  # points behind the camera do not end in nan
    assert np.isfinite(fit_pose(turned, seen, PINHOLE).T_board_cam).all()


# ---------------------------------------------------------------------------------------------- the pose from markers


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_26_markers_at_a_fifth_of_a_pixel_give_a_fifth_of_a_millimetre(camera):
    """The arithmetic of the article's warning: 104 corners at 0.2 px and 0.8 m give 0.2 mm and 0.015 degrees."""
    rng, found = np.random.default_rng(0), []
    for T in hand_held(rng, 40, distance_m=(0.8, 0.8), inclination_rad=(0.8, 1.1)):
        view = observe(T, rng, camera=camera, ids=rng.choice(35, 26, replace=False))
        found.append(errors(fit_markers(view, camera).fit.T_board_cam, T))
    mm, degrees = np.sqrt(np.mean(np.square(found), axis=0) / 3)  # an axis
    assert 0.1 < mm < 0.3 and 0.008 < degrees < 0.025


@pytest.mark.minute
def test_the_covariance_tells_the_errors():
    rng, squares = np.random.default_rng(1), []
    for T in hand_held(rng, 100):
        fit = fit_markers(observe(T, rng, ids=range(9, 26)), PINHOLE).fit
        d = T[:3, :3].T @ (fit.T_board_cam[:3, 3] - T[:3, 3])
        squares.append(d @ np.linalg.solve(0.04 * np.linalg.inv(fit.information)[:3, :3], d))
    assert 2.2 < np.mean(squares) < 4.0  # chi-square of three


@pytest.mark.minute
def test_one_small_marker_is_ambiguous_and_a_whole_board_is_not():
    rng, one, whole = np.random.default_rng(2), [], []
    for T in hand_held(rng, 30, distance_m=(2.5, 2.5)):
        one.append(fit_markers(observe(T, rng, ids=[17]), PINHOLE).is_ambiguous(0.2))
        whole.append(fit_markers(observe(T, rng), PINHOLE).is_ambiguous(0.2))
    assert np.mean(one) > 0.5 and not any(whole)
    for T in hand_held(rng, 10, distance_m=(1.2, 1.2)):  # of the two poses that look alike one is near the truth
        corners = observe(T, rng, ids=[17]).corners
        starts = first_poses(corners.board, corners.rays)
        assert min(errors(start, T)[1] for start in starts) < 10  # degrees; before refinement


def test_a_frontal_board_is_no_trap_and_a_mirrored_one_or_too_few_markers_are_no_pose():
    rng = np.random.default_rng(4)
    for _ in range(10):
        T = look_at(np.array([*rng.normal(0, 0.01, 2), 0.8]), np.zeros(3))
        mm, degrees = errors(fit_markers(observe(T, rng), PINHOLE).fit.T_board_cam, T)
        assert mm < 2 and degrees < 0.15
    for T in hand_held(rng, 5):
        corners = observe(T, rng, corner_px=0).corners
        mirrored = dataclasses.replace(corners, board=corners.board * np.array([-1.0, 1, 1]))
        found = fit_markers(Observation(0, mirrored), PINHOLE)
        assert found.fit is None and "mirrored" in found.reason
    found = fit_markers(observe(T0, rng, ids=[]), PINHOLE)
    assert found.fit is None and found.reason == "no markers of the board found"


# ---------------------------------------------------------------------------------------------- the verdict


def patches_on_board(lift_m=0.0):
    """Nine patches of the board whose depth says that it lies `lift_m` higher."""
    x, y = np.meshgrid([-0.2, 0, 0.2], [-0.1, 0, 0.1])
    p = transform(invert(T0), np.column_stack([x.ravel(), y.ravel(), np.full(9, lift_m)]))
    return Patches(p, p / p[:, 2:], np.zeros((9, 3)), np.full(9, 0.001))


def test_a_view_is_used_flagged_or_refused_with_the_number_measured():
    view = observe(T0, np.random.default_rng(0))
    evidence, none = evidence_of([view]), DepthCorrection()
    good = judge(dataclasses.replace(view, board_patches=patches_on_board(0.004)), Judged(T0), evidence, none)
    assert good.status == "used" and good.depth_mm == pytest.approx(4.0) and good.reprojection_px < 0.3
    lifted = DepthCorrection(0.01, 1.02, translation(0.1, 0, 0))  # scale, then offset, then the depth camera's place
    board = patches_on_board()
    expected = transform(T0, board.ray_z * 1.02 + 0.01 * board.ray + np.array([0.1, 0, 0]))[:, 2]
    told = judge(dataclasses.replace(view, board_patches=board), Judged(T0), evidence, lifted).depth_mm
    assert told == pytest.approx(1000 * np.median(np.abs(expected)))
    off = judge(view, Judged(moved(T0, np.array([0, 0, 0, 0, 0.01, 0]))), evidence, none)
    assert off.status == "flagged" and "above 3: the markers do not lie" in off.reasons[0]
    assert f"{off.reprojection_px:.2f} px" in off.reasons[0]
    unsure = judge(view, Judged(T0, np.diag([1e-8] * 3 + [0.03**2] * 3)), evidence, none)
    assert len(unsure.reasons) == 1 and "the pose is uncertain: 0.1 mm, 1.7" in unsure.reasons[0]
    poor = observe(T0, np.random.default_rng(3), corner_px=0.6)  # fits worse than others: it is less certain
    widened = judge(poor, Judged(T0, np.diag([1e-8] * 6)), evidence, none).covariance
    assert widened[0, 0] / 1e-8 == pytest.approx((0.6 / evidence.corner_px) ** 2, rel=0.3)
    for nothing in (None, np.full((4, 4), np.nan)):
        refused = judge(view, Judged(nothing), evidence, none)
        assert refused.status == "refused" and refused.T_board_cam is None and refused.reasons
