"""The whole silhouette of an object in a view: what is seen of it, what others hide, and what lies outside the image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.dataset.codec import Row, read_camera, read_matrix
from schemas.scene.camera import Camera
from schemas.scene.scene import Placed
from schemas.scene.shape import Shape
from workers.geometry.camera import project_bounds
from workers.geometry.frames import transform
from workers.geometry.raycast import NEAR_M, cast_view

_FARTHEST = 3
"""Silhouettes are followed so many image sizes beyond the image."""

Box = tuple[int, int, int, int]
"""x, y, width, height, pixels; all -1 where there is nothing."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """mask [H, W] bool: the part inside the image; pixels and box are of all of it, in the image's coordinates."""

    mask: NDArray[np.bool_]
    pixels: int
    box: Box


def whole_silhouette(label: Row, view: Row, visible: NDArray[np.bool_], shape: Shape | None) -> Silhouette | None:
    """The silhouette of the object of `label`, of which `visible` [H, W] is seen.

    Nothing is cast where all of it is seen. Otherwise rays through pixel centres meet its mesh alone; None without a shape.
    """
    if label["visible_fraction"] >= 1.0:
        return Silhouette(visible, int(visible.sum()), box_of(visible))
    if shape is None:
        return None
    camera, T_cam_obj = read_camera(view), read_matrix(label["T_cam_obj"])
    left, top, right, bottom = _window(shape, T_cam_obj, camera)
    k = camera.intrinsics
    seen_by = k.model_copy(update={"width": right - left, "height": bottom - top, "cx": k.cx - left, "cy": k.cy - top})
    _, region, _ = cast_view([Placed(1, shape, T_cam_obj)], Camera(seen_by, np.eye(4)))
    whole = region > 0
    inside = np.s_[-top : k.height - top, -left : k.width - left]
    whole[inside] |= visible  # at an edge, rays and the renderer may differ by a pixel
    x, y, width, height = box_of(whole)
    box = (x + left, y + top, width, height) if width > 0 else (x, y, width, height)
    return Silhouette(whole[inside], int(whole.sum()), box)


def box_of(mask: NDArray[np.bool_]) -> Box:
    """The bounding box of a mask."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return -1, -1, -1, -1
    x, y = int(columns[0]), int(rows[0])
    return x, y, int(columns[-1]) + 1 - x, int(rows[-1]) + 1 - y


def _window(shape: Shape, T_cam_obj: NDArray, camera: Camera) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) of a window that holds the image and the object, in the image's pixels."""
    k = camera.intrinsics
    u_low, v_low, u_high, v_high = project_bounds(transform(T_cam_obj, shape.vertices), k, NEAR_M)
    far_x, far_y = _FARTHEST * k.width, _FARTHEST * k.height
    left, right = np.clip([np.floor(u_low) - 1, np.ceil(u_high) + 1], -far_x, k.width + far_x).astype(int)
    top, bottom = np.clip([np.floor(v_low) - 1, np.ceil(v_high) + 1], -far_y, k.height + far_y).astype(int)
    return min(int(left), 0), min(int(top), 0), max(int(right), k.width), max(int(bottom), k.height)
