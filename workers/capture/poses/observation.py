"""What one view observes: rays through pixels, corners and depth samples.

- Pixels to rays and board points to pixels, through the lens, by OpenCV's own model.
- What the estimates know of one view: its corners as rays, where they lie on the board, and samples of its depth.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.capture import CaptureCamera, Detection
from schemas.job.captures import Board, Estimation
from schemas.scene.view import Intrinsics
from workers.capture.board.layout import marker_corners
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


@dataclass(frozen=True, eq=False)
class Corners:
    """The corners found in one view.

    board [K, 3] metres, where they lie on the board; pixels [K, 2] as stored, centres at +0.5; rays [K, 2] (x / z, y / z);
    markers [K] ids; depth_m [K]: depth measured around the corner, 0 where there is none.
    """

    board: Array
    pixels: Array
    rays: Array
    markers: NDArray[np.int64]
    depth_m: Array


@dataclass(frozen=True, eq=False)
class Patches:
    """Small pieces of surface measured by depth, P of them.

    ray_z [P, 3]: mean of ray z, metres; ray [P, 3]: mean of the rays (x, y, 1): with these a correction of depth by scale and
    offset is exact; normal [P, 3]: unit, towards the camera, camera axes; pixels [P]: how many were averaged; sigma_m [P]:
    standard deviation of a pixel about the patch's own plane.
    """

    ray_z: Array
    ray: Array
    normal: Array
    pixels: NDArray[np.int64]
    sigma_m: Array

    def __len__(self) -> int:
        return len(self.ray_z)


def no_patches() -> Patches:
    """None at all."""
    none = np.zeros((0, 3))
    return Patches(none, none, none, np.zeros(0, np.int64), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Observation:
    """One view: its corners, its depth on the board's markers and on the object; `manual_T_board_cam` where somebody gave one."""

    number: int
    corners: Corners
    board_patches: Patches = field(default_factory=no_patches)
    object_patches: Patches = field(default_factory=no_patches)
    has_depth: bool = False
    manual_T_board_cam: Pose | None = None
    given_by: str = ""
    """Where the pose that was given is from, in words."""

    @property
    def markers(self) -> int:
        """How many markers were found."""
        return len(self.corners.board) // 4


@dataclass(frozen=True, eq=False)
class Setup:
    """What is known of a capture before its images are read."""

    camera: CaptureCamera
    board: Board
    spec: Estimation


def corners_of(detection: Detection, board: Board, camera: CaptureCamera) -> Corners:
    """The corners of the detected markers; a marker where the lens cannot be inverted is left out. No depth yet."""
    pixels = detection.corners_px.reshape(-1, 2)
    rays = rays_of_pixels(pixels, camera)
    whole = np.repeat(np.isfinite(rays).all(axis=1).reshape(-1, 4).all(axis=1), 4)
    points = marker_corners(board)[detection.ids - board.first_id].reshape(-1, 3)
    ids = np.repeat(detection.ids, 4)
    return Corners(points[whole], pixels[whole], rays[whole], ids[whole], np.zeros(int(whole.sum())))
