"""The pinhole camera: its pose, projection of points, and unprojection of pixels."""

import math

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.camera import Intrinsics
from workers.geometry.frames import UP, pose


def look_at(position: Array, target: Array, up: Array = UP) -> Pose:
    """Camera to world, [4, 4] float64, optical frame, zero roll: the image's x axis is level.

    For a camera that looks straight up or down the image's x axis is the world's.
    """
    z = target - position
    z = z / np.linalg.norm(z)
    x = np.cross(z, up)
    length = float(np.linalg.norm(x))
    x = x / length if length > 1e-12 else np.array([1.0, 0.0, 0.0])
    y = np.cross(z, x)
    return pose(np.stack([x, y, z], axis=1), position)


def orbit_pose(centre: Array, inclination_rad: float, yaw_rad: float, radius_m: float) -> Pose:
    """A zero-roll camera on a sphere about `centre` that looks at it, [4, 4] float64, optical frame.

    `inclination_rad` is the angle of the optical axis below the horizontal; at yaw 0 the camera stands on +x [A].
    """
    level = math.cos(inclination_rad)
    towards = np.array([level * math.cos(yaw_rad), level * math.sin(yaw_rad), math.sin(inclination_rad)])
    return look_at(centre + radius_m * towards, centre)


def inclination(T_world_cam: Pose) -> float:
    """Angle of the optical axis below the horizontal, radians: atan2(-R22, hypot(R02, R12)) [C]."""
    return math.atan2(-T_world_cam[2, 2], math.hypot(T_world_cam[0, 2], T_world_cam[1, 2]))


def yaw(T_world_cam: Pose) -> float:
    """Direction from the target to the camera about the world's z, radians in [-pi, pi]."""
    return math.atan2(-T_world_cam[1, 2], -T_world_cam[0, 2])


def unproject(rows: NDArray, columns: NDArray, depth_m: Array, intrinsics: Intrinsics) -> Array:
    """[N, 3] float64: points in the camera frame at depth z on the rays through the centres, at +0.5, of pixels."""
    x = (columns + 0.5 - intrinsics.cx) / intrinsics.fx * depth_m
    y = (rows + 0.5 - intrinsics.cy) / intrinsics.fy * depth_m
    return np.stack([x, y, depth_m], axis=1)


def project(points_cam: Array, intrinsics: Intrinsics) -> tuple[Array, Array]:
    """(u, v), each [N] float64: image coordinates, pixels from the image's left and upper edge.

    Points must lie in front of the camera (z > 0).
    """
    z = points_cam[:, 2]
    return (
        intrinsics.fx * points_cam[:, 0] / z + intrinsics.cx,
        intrinsics.fy * points_cam[:, 1] / z + intrinsics.cy,
    )


def project_bounds(points_cam: Array, intrinsics: Intrinsics, near_m: float) -> tuple[float, float, float, float]:
    """(left, top, right, bottom), pixels, of projected points [N, 3], N > 0, which may lie outside the image.

    The bounds of the image where a point is not beyond the near plane.
    """
    if (points_cam[:, 2] <= near_m).any():
        return 0.0, 0.0, float(intrinsics.width), float(intrinsics.height)
    u, v = project(points_cam, intrinsics)
    return float(u.min()), float(v.min()), float(u.max()), float(v.max())


def image_coordinates(T_cam_obj: Pose, intrinsics: Intrinsics) -> tuple[int, int]:
    """The pixel of an object's origin, (-1, -1) where it is outside the image or behind the camera (dataset.md)."""
    origin = T_cam_obj[:3, 3]
    if origin[2] <= 0.0:
        return -1, -1
    (u,), (v,) = project(origin[None, :], intrinsics)
    if not (0.0 <= u < intrinsics.width and 0.0 <= v < intrinsics.height):
        return -1, -1
    return math.floor(u), math.floor(v)
