"""A view with its pose and without its lens: what merging and synthesis start from."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose, frozen_array
from schemas.capture.estimate import DepthCorrection
from schemas.capture.view import CaptureCamera, CapturedView
from schemas.errors import CaptureError
from schemas.scene.view import Camera
from workers.capture.poses.rays import opencv_matrix
from workers.geometry.jit import compiled

Depth = NDArray[np.float32]
"""[H, W] z along the optical axis, metres, 0 where there is none."""


@dataclass(frozen=True, eq=False)
class PosedView:
    """The pictures of one view as pinholes see them, in the board frame.

    `camera` took rgb [H, W, 3] uint8 and mask [H, W] bool (None where none was given). `depth_camera` took depth_m [H, W]
    float32: it has the same intrinsics and stands where the estimate has the depth camera of the registered images.
    """

    number: int
    camera: Camera
    depth_camera: Camera
    rgb: NDArray[np.uint8]
    depth_m: Depth
    mask: NDArray[np.bool_] | None = None


def pose_view(view: CapturedView, camera: CaptureCamera, T_board_cam: Pose, depth: DepthCorrection) -> PosedView:
    """The view without its lens, its depth corrected. Raises CaptureError where it has no depth image."""
    if view.depth is None:
        raise CaptureError("no_depth", f"view {view.number} has no depth image: depth_{view.number:05d}.png is missing")
    k = camera.intrinsics
    rgb, stored, mask = view.rgb, view.depth, view.mask
    if camera.has_lens:
        columns, rows = lens_map(camera)
        rgb = cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR).astype(np.uint8, copy=False)
        stored = _nearest(stored, columns, rows)
        mask = None if mask is None else _nearest(mask.view(np.uint8), columns, rows).view(np.bool_)
    depth_m = correct_depth(stored, 1.0 / camera.depth_units_per_m, depth.scale, depth.offset_m)
    T_board_depth = frozen_array(T_board_cam @ depth.T_cam_depth)
    return PosedView(view.number, Camera(k, frozen_array(T_board_cam)), Camera(k, T_board_depth), rgb, depth_m, mask)


@compiled
def correct_depth(stored: NDArray[np.uint16], metres: float, scale: float, offset_m: float) -> Depth:
    """[H, W] float32: stored depth in metres after a correction; 0 stays 0, and what is corrected to below 0 becomes 0."""
    depth = np.zeros(stored.shape, np.float32)
    for row in range(stored.shape[0]):
        for column in range(stored.shape[1]):
            if stored[row, column] > 0:
                depth[row, column] = max(stored[row, column] * metres * scale + offset_m, 0.0)
    return depth


def lens_map(camera: CaptureCamera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(columns, rows), each [H, W] float32: where in the stored image each pixel of the pinhole's lies, OpenCV's convention."""
    k = camera.intrinsics
    matrix = opencv_matrix(k)
    columns, rows = cv2.initUndistortRectifyMap(
        matrix, camera.lens, np.eye(3), matrix, (k.width, k.height), cv2.CV_32FC1
    )
    return columns.astype(np.float32, copy=False), rows.astype(np.float32, copy=False)


def distort_mask(mask: NDArray[np.bool_], camera: CaptureCamera) -> NDArray[np.bool_]:
    """[H, W] bool: a pinhole's mask as the lens draws it, so that it fits the stored images."""
    if not camera.has_lens:
        return mask
    k = camera.intrinsics
    matrix = opencv_matrix(k)
    rows, columns = np.mgrid[0 : k.height, 0 : k.width].astype(np.float64)
    stored = np.stack([columns.ravel(), rows.ravel()], axis=1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(stored, matrix, camera.lens, P=matrix).reshape(k.height, k.width, 2)
    columns32, rows32 = (straight[..., i].astype(np.float32) for i in range(2))
    return _nearest(mask.view(np.uint8), columns32, rows32).view(np.bool_)


def _nearest(image: NDArray, columns: NDArray[np.float32], rows: NDArray[np.float32]) -> NDArray:
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0))
