"""Test of point clouds against the view frusta of cameras."""

from collections.abc import Sequence

import numpy as np

from schemas.base import Array
from schemas.scene.camera import Camera, Intrinsics
from workers.geometry.frames import invert, transform

MARGIN_PX = 2.0
"""Width by which the image is extended on each side: what lies outside of that touches no sample of a pixel."""


def is_outside_views(points: Array, cameras: Sequence[Camera]) -> bool:
    """Whether the convex hull of points [N, 3], world, is certainly outside the image of every camera between these.

    The cameras have the same rotation and intrinsics, and stand for every camera on the lines between them. So each side
    of the image is one bundle of parallel planes, and the hull is outside where all points as seen from all cameras lie
    beyond one of them, or below every camera while the whole image looks up. False leaves it open.
    """
    k, rotation = cameras[0].intrinsics, cameras[0].T_world_cam[:3, :3]
    if (_corner_rays(k) @ rotation[2] > 0.0).all():
        lowest = min(float(camera.T_world_cam[2, 3]) for camera in cameras)
        if float(points[:, 2].max()) < lowest:
            return True
    seen = np.concatenate([transform(invert(camera.T_world_cam), points) for camera in cameras])
    return bool((seen @ _side_normals(k).T < 0.0).all(axis=0).any())


def _side_normals(k: Intrinsics) -> Array:
    """[5, 3]: inward normals, in the optical frame, of the image's four sides and of the plane of the camera itself.

    For the left side: u = fx X / Z + cx > -margin for Z > 0 is fx X + (cx + margin) Z > 0.
    """
    left, top = k.cx + MARGIN_PX, k.cy + MARGIN_PX
    right, bottom = k.width + MARGIN_PX - k.cx, k.height + MARGIN_PX - k.cy
    return np.array([[k.fx, 0.0, left], [-k.fx, 0.0, right], [0.0, k.fy, top], [0.0, -k.fy, bottom], [0.0, 0.0, 1.0]])


def _corner_rays(k: Intrinsics) -> Array:
    """[4, 3]: the rays through the image's corners, in the optical frame; every other is between them."""
    columns, rows = (-MARGIN_PX, k.width + MARGIN_PX), (-MARGIN_PX, k.height + MARGIN_PX)
    return np.array([[(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0] for v in rows for u in columns])
