"""What one view tells: rays, corners, patches of depth, its pose from markers, and the verdict on it."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from schemas.capture import CaptureCamera, DepthCorrection, Detection
from schemas.job.captures import Board, Estimation
from tests.workers.capture.drawn import (
    BOX,
    HALF,
    KINECT,
    LENS,
    PINHOLE,
    QUARTER,
    DepthErrors,
    Virtual,
    errors,
    evidence_of,
    hand_held,
    measured_depth,
    observe,
    one_view,
    project,
)
from workers.capture.board import marker_corners
from workers.capture.poses.markers import (
    Judged,
    first_poses,
    fit_markers,
    fit_pose,
    judge,
    measured_corner_px,
    observe_view,
)
from workers.capture.poses.observation import (
    MOST,
    Observation,
    Patches,
    Setup,
    board_patches,
    corners_of,
    depth_at,
    fit_patches,
    no_patches,
    object_patches,
    pixels_of_points,
)
from workers.capture.poses.terms import cross_matrix, motion_between, moved
from workers.geometry.camera import look_at
from workers.geometry.frames import invert, pose, transform, translation
from workers.geometry.pixels import rays_of_pixels

SPEC = Estimation()
FOCAL = np.array([KINECT.fx, KINECT.fy])
SETUP = Setup(CaptureCamera(HALF, np.zeros(8)), Board(), SPEC)
T0 = hand_held(np.random.default_rng(0), 1)[0]


# ---------------------------------------------------------------------------------------------- rays and corners


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_rays_and_pixels_are_inverse_and_agree_with_opencv(camera):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.2, 0.2, (50, 2)), rng.uniform(0, 0.1, 50)])
    pixels = project(points, T0, camera)
    assert pixels_of_points(points, T0, camera) == pytest.approx(pixels, abs=1e-9)
    p = transform(invert(T0), points)
    rays = rays_of_pixels(pixels, camera.intrinsics, camera.lens)
    assert rays == pytest.approx(p[:, :2] / p[:, 2:], abs=1e-7)
    assert np.isnan(pixels_of_points((T0[:3, 3] - T0[:3, 2])[None], T0, camera)).all(), "behind the camera"


def test_corners_are_paired_by_id_and_left_out_where_the_lens_folds():
    board = Board(first_id=5, measured_ruler_m=0.202)
    points = marker_corners(board)
    pixels = project(points.reshape(-1, 3), T0, PINHOLE).reshape(-1, 4, 2)
    corners = corners_of(Detection(0, np.array([6, 30]), pixels[[1, 25]]), board, PINHOLE)
    assert corners.board == pytest.approx(points[[1, 25]].reshape(-1, 3))
    assert list(corners.markers) == [6] * 4 + [30] * 4
    assert Observation(0, corners).markers == 2 and not corners.depth_m.any()
    folding = CaptureCamera(KINECT, np.array([-0.6, 0, 0, 0, 0, 0, 0, 0]))
    square = np.array([[-8, -8], [8, -8], [8, 8], [-8, 8.0]])
    detection = Detection(0, np.array([5, 6]), np.stack([square + np.array([960, 540]), square + 9]))
    assert list(corners_of(detection, board, folding).markers) == [5] * 4


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


def test_depth_of_a_corner_is_the_median_around_it():
    depth = np.full((20, 20), 800, np.uint16)
    depth[9:12, 9:12], depth[8, 8] = 0, 5000
    assert depth_at(depth, np.array([[10.5, 10.5], [0.2, 19.9]]), 1000) == pytest.approx([0.8, 0.8])
    assert depth_at(np.zeros_like(depth), np.array([[10.5, 10.5]]), 1000) == [0.0]
    assert depth_at(depth, np.zeros((0, 2)), 1000).shape == (0,)


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


def test_a_view_comes_to_corners_pose_and_samples_of_depth():
    rng, setup = np.random.default_rng(0), Setup(CaptureCamera(QUARTER, np.zeros(8)), Board(), SPEC)
    seen, found = one_view(4, T0, Virtual(), setup, rng)
    assert (seen.corners.depth_m > 0).all() and len(seen.board_patches) > 20 and len(seen.object_patches) > 10
    assert errors(found.fit.T_board_cam, T0)[0] < 1.5
    nothing = Detection(2, np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    for depth in (None, np.zeros((270, 480), np.uint16)):
        seen, found = observe_view(nothing, depth, setup)
        assert found.fit is None and seen.markers == 0 and not len(seen.board_patches) + len(seen.object_patches)


# ---------------------------------------------------------------------------------------------- motions and fits


def test_small_motions_are_scipys_and_made_in_the_axes_of_the_camera():
    rng = np.random.default_rng(0)
    for length in (0.0, 1e-14, 1e-9, 1e-4, 0.5, 3.0):
        vector = rng.standard_normal(3)
        vector *= length / np.linalg.norm(vector)
        turned = moved(np.eye(4), np.r_[0, 0, 0, vector])
        assert turned[:3, :3] == pytest.approx(expm(cross_matrix(vector)), abs=1e-13)
        assert motion_between(np.eye(4), turned)[3:] == pytest.approx(vector, abs=1e-12)
    R = Rotation.from_euler("xyz", [0.3, -0.4, 0.5]).as_matrix()
    T = moved(pose(R, np.array([1.0, 2, 3])), np.array([0.1, 0, 0, 0, 0, 0.2]))
    assert T[:3, 3] == pytest.approx(np.array([1, 2, 3]) + 0.1 * R[:, 0])
    assert T[:3, :3] == pytest.approx(R @ Rotation.from_rotvec([0, 0, 0.2]).as_matrix())


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


def test_the_covariance_tells_the_errors():
    rng, squares = np.random.default_rng(1), []
    for T in hand_held(rng, 100):
        fit = fit_markers(observe(T, rng, ids=range(9, 26)), PINHOLE).fit
        d = T[:3, :3].T @ (fit.T_board_cam[:3, 3] - T[:3, 3])
        squares.append(d @ np.linalg.solve(0.04 * np.linalg.inv(fit.information)[:3, :3], d))
    assert 2.2 < np.mean(squares) < 4.0  # chi-square of three


def test_one_small_marker_is_ambiguous_and_a_whole_board_is_not():
    rng, one, whole = np.random.default_rng(2), [], []
    for T in hand_held(rng, 30, distance_m=(2.5, 2.5)):
        one.append(fit_markers(observe(T, rng, ids=[17]), PINHOLE).is_ambiguous(0.2))
        whole.append(fit_markers(observe(T, rng), PINHOLE).is_ambiguous(0.2))
    assert np.mean(one) > 0.5 and not any(whole)
    for T in hand_held(rng, 10, distance_m=(1.2, 1.2)):  # of the two poses that look alike one is near the truth
        starts = first_poses(observe(T, rng, ids=[17]).corners)
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


def test_the_sigma_of_a_corner_is_measured_over_all_views():
    rng = np.random.default_rng(7)
    for corner_px in (0.1, 0.2, 0.5):
        evidence = evidence_of([observe(T, rng, corner_px=corner_px) for T in hand_held(rng, 10)])
        assert evidence.corner_px == pytest.approx(corner_px, rel=0.1)
    assert measured_corner_px([], SPEC) == SPEC.corner_px


# ---------------------------------------------------------------------------------------------- the verdict


def patches_on_board(lift_m=0.0):
    """Nine patches of the board whose depth says that it lies `lift_m` higher."""
    x, y = np.meshgrid([-0.2, 0, 0.2], [-0.1, 0, 0.1])
    p = transform(invert(T0), np.column_stack([x.ravel(), y.ravel(), np.full(9, lift_m)]))
    return Patches(p, p / p[:, 2:], np.zeros((9, 3)), np.full(9, 50), np.full(9, 0.001))


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
