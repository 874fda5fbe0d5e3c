"""A capture: its camera, the images of one view, and the markers that were found in it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.job.views import Distortion
from schemas.scene.view import Intrinsics


@dataclass(frozen=True, eq=False)
class CaptureCamera:
    """The colour camera of a capture: a pinhole with pixel centres at +0.5, and the lens of its stored images.

    `lens` holds OpenCV's rational model in OpenCV's order (k1, k2, p1, p2, k3, k4, k5, k6), [8] float64, all 0 for a
    pinhole. Depth images have `depth_units_per_m` units a metre and are registered to this camera.
    """

    intrinsics: Intrinsics
    lens: Array
    depth_units_per_m: float = 1000.0

    @property
    def has_lens(self) -> bool:
        """Whether the stored images are distorted."""
        return bool(np.any(self.lens))


@dataclass(frozen=True, eq=False)
class CapturedView:
    """The images of one view as they are stored.

    rgb [H, W, 3] uint8 sRGB; depth [H, W] uint16, z along the optical axis in units of the camera, 0 where there is none,
    or None; mask [H, W] bool of the object, or None where none was given.
    """

    number: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None
    mask: NDArray[np.bool_] | None


@dataclass(frozen=True, eq=False)
class Detection:
    """The markers found in one view.

    ids [M] int64, ascending, unique; corners_px [M, 4, 2] float64, as stored (not undistorted), pixel centres at +0.5, in
    the order top left, top right, bottom right, bottom left of the printed marker. `dropped` says in words what was found and
    not used (a marker twice, an id that is not on the board).
    """

    number: int
    ids: NDArray[np.int64]
    corners_px: Array
    dropped: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class CaptureTruth:
    """What a simulated capture knows and no real one does.

    T_board_cam [V, 4, 4] by view number; T_board_obj [4, 4] pose of the object's mesh; `print_scale` true size of the print
    over its nominal size; T_color_depth [4, 4] true pose of the depth camera in the colour camera's frame; `depth_bias_m`
    further systematic error that was asked for.
    """

    T_board_cam: Array
    T_board_obj: Pose
    print_scale: float
    T_color_depth: Pose
    depth_bias_m: float
    lens: Distortion | None
