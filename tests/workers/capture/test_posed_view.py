"""Views without their lens, held against OpenCV's projectPoints, and corrected depth."""

import cv2
import numpy as np
import pytest

from schemas.capture import CaptureCamera, CapturedView, DepthCorrection
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.capture.poses.observation import opencv_matrix
from workers.capture.surface.posed_view import correct_depth, distort_mask, pose_view

K = Intrinsics(width=240, height=180, fx=200.0, fy=205.0, cx=121.3, cy=88.7)
LENS = np.array([0.12, -0.2, 0.002, -0.003, 0.05, 0.0, 0.0, 0.0])
POINTS = np.array([[-0.35, -0.25, 1.0], [0.3, 0.25, 1.0], [0.02, -0.3, 1.0], [-0.4, 0.3, 1.0]])


def blobs(centres):
    """A picture of small round blobs; centres (u, v) with pixel centres on integers."""
    rows, columns = np.mgrid[0:180, 0:240]
    light = sum(np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 2.5**2)) for u, v in centres)
    return np.repeat(np.rint(250 * light)[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)


def centre_near(image, u, v):
    """Centroid, pixel centres on integers, of what is bright about a place."""
    rows, columns = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    w = np.where(np.hypot(columns - u, rows - v) < 9, image.astype(float), 0.0)
    return (columns * w).sum() / w.sum(), (rows * w).sum() / w.sum()


def stored_places(lens):
    return cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), opencv_matrix(K), lens)[0].reshape(-1, 2)


def test_the_picture_without_its_lens_shows_points_where_the_pinhole_has_them():
    view = CapturedView(3, blobs(stored_places(LENS)), np.full((180, 240), 1000, np.uint16), None)
    posed = pose_view(view, CaptureCamera(K, LENS), np.eye(4), DepthCorrection())
    assert np.hypot(*(stored_places(np.zeros(8)) - stored_places(LENS)).T).max() > 2.0
    for u, v in stored_places(np.zeros(8)):
        assert np.hypot(*np.subtract(centre_near(posed.rgb[..., 0], u, v), (u, v))) < 0.15


def test_a_mask_drawn_by_the_lens_lies_where_the_lens_puts_it():
    straight = stored_places(np.zeros(8))
    rows, columns = np.mgrid[0:180, 0:240]
    mask = np.zeros((180, 240), bool)
    for u, v in straight:
        mask |= np.hypot(columns - u, rows - v) < 5
    drawn = distort_mask(mask, CaptureCamera(K, LENS))
    for u, v in stored_places(LENS):
        assert np.hypot(*np.subtract(centre_near(drawn, u, v), (u, v))) < 0.5


def test_a_camera_without_lens_keeps_pictures_as_they_are():
    view = CapturedView(0, blobs([(50, 60)]), np.full((180, 240), 700, np.uint16), np.eye(180, 240, dtype=bool))
    camera = CaptureCamera(K, np.zeros(8))
    posed = pose_view(view, camera, np.eye(4), DepthCorrection())
    assert posed.rgb is view.rgb and posed.mask is view.mask and distort_mask(view.mask, camera) is view.mask
    assert np.allclose(posed.depth_m, 0.7)


def test_depth_is_scaled_before_it_is_shifted_and_what_is_missing_stays_missing():
    stored = np.array([[0, 1000, 500]], np.uint16)
    assert np.allclose(correct_depth(stored, 0.001, 1.02, -0.01), [[0.0, 1.01, 0.5]])
    assert np.array_equal(correct_depth(np.array([[5]], np.uint16), 0.001, 1.0, -0.01), [[0.0]])


def test_the_depth_camera_stands_where_the_correction_puts_it():
    T_board_cam, T_cam_depth = np.eye(4), np.eye(4)
    T_board_cam[:3, 3], T_cam_depth[:3, 3] = [1, 2, 3], [0.01, 0, 0]
    view = CapturedView(0, blobs([(50, 60)]), np.full((180, 240), 700, np.uint16), None)
    posed = pose_view(view, CaptureCamera(K, np.zeros(8)), T_board_cam, DepthCorrection(T_cam_depth=T_cam_depth))
    assert np.allclose(posed.depth_camera.position, [1.01, 2, 3]) and np.allclose(posed.camera.position, [1, 2, 3])


def test_a_view_without_depth_is_refused():
    with pytest.raises(CaptureError, match=r"depth_00007\.png is missing"):
        pose_view(
            CapturedView(7, blobs([(5, 6)]), None, None), CaptureCamera(K, np.zeros(8)), np.eye(4), DepthCorrection()
        )
