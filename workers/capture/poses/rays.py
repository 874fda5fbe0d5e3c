"""Pixels to rays and board points to pixels, through the lens, by OpenCV's own model."""

import cv2
import numpy as np

from schemas.base import Array, Pose
from schemas.capture.view import CaptureCamera
from schemas.scene.view import Intrinsics
from workers.geometry.frames import invert

ROUND_TRIP_PX = 0.05
"""A pixel whose ray does not lead back to it by less than this lies where the lens model folds: it has no ray."""
ITERATIONS = 60


def opencv_matrix(k: Intrinsics) -> Array:
    """[3, 3] float64: the camera matrix as OpenCV has it, the first pixel's centre at 0."""
    return np.array([[k.fx, 0.0, k.cx_opencv], [0.0, k.fy, k.cy_opencv], [0.0, 0.0, 1.0]])


def rays_of_pixels(pixels: Array, camera: CaptureCamera) -> Array:
    """[N, 2] float64: (x / z, y / z) of stored pixels [N, 2], centres at +0.5; nan where the lens model cannot be inverted."""
    k = camera.intrinsics
    rays = (pixels - np.array([k.cx, k.cy])) / np.array([k.fx, k.fy])
    if not camera.has_lens or not len(rays):
        return rays
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, ITERATIONS, 1e-10)
    found = cv2.undistortPoints((pixels - 0.5).reshape(-1, 1, 2), opencv_matrix(k), camera.lens, criteria=stop)
    rays = found.reshape(-1, 2).astype(np.float64)
    back = _distorted(np.column_stack([rays, np.ones(len(rays))]), camera)
    with np.errstate(invalid="ignore"):
        bad = ~(np.linalg.norm(back - pixels, axis=1) <= ROUND_TRIP_PX)
    rays[bad] = np.nan
    return rays


def pixels_of_points(points_board: Array, T_board_cam: Pose, camera: CaptureCamera) -> Array:
    """[N, 2] float64: stored pixels, centres at +0.5, of board points [N, 3]; nan behind the camera."""
    T = invert(T_board_cam)
    points_cam = points_board @ T[:3, :3].T + T[:3, 3]
    pixels = _distorted(points_cam, camera)
    pixels[points_cam[:, 2] <= 0] = np.nan
    return pixels


def _distorted(points_cam: Array, camera: CaptureCamera) -> Array:
    if not len(points_cam):
        return np.zeros((0, 2))
    zero, matrix = np.zeros(3), opencv_matrix(camera.intrinsics)
    found, _ = cv2.projectPoints(points_cam.reshape(-1, 1, 3), zero, zero, matrix, camera.lens)
    pixels: Array = found.reshape(-1, 2).astype(np.float64) + 0.5
    return pixels
