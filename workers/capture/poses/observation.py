"""What the estimates know of one view: its corners as rays, where they lie on the board, and samples of its depth."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.capture.view import CaptureCamera, Detection
from schemas.job.captures import Board, Estimation
from workers.capture.board.layout import marker_corners
from workers.capture.poses.rays import rays_of_pixels


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
