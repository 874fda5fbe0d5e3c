"""The pinhole camera: pose and frustum, projection of points, unprojection of pixels, bounds, near plane, choice among views."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.frames import UP, cross, invert, pose, transform

MARGIN_PX = 2.0
"""Width by which the image is extended on each side: what lies outside of that touches no sample of a pixel."""

NEAR_M = 0.05
"""Surfaces nearer than this, along the optical axis, are not seen: the near plane of the fast renderer."""


def look_at(position: Array, target: Array, up: Array = UP) -> Pose:
    """Camera to world, [4, 4] float64, optical frame, zero roll: the image's x axis is level.

    For a camera that looks straight up or down the image's x axis is the world's.
    """
    z = target - position
    z = z / np.linalg.norm(z)
    x = cross(z, up)
    length = float(np.linalg.norm(x))
    x = x / length if length > 1e-12 else np.array([1.0, 0.0, 0.0])
    return pose(np.array([x, cross(z, x), z]).T, position)


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
    return (intrinsics.fx * points_cam[:, 0] / z + intrinsics.cx, intrinsics.fy * points_cam[:, 1] / z + intrinsics.cy)


def project_bounds(points_cam: Array, intrinsics: Intrinsics, near_m: float) -> tuple[float, float, float, float]:
    """(left, top, right, bottom), pixels, of projected points [N, 3], N > 0, which may lie outside the image.

    The bounds of the image where a point is not beyond the near plane.
    """
    if (points_cam[:, 2] <= near_m).any():
        return 0.0, 0.0, float(intrinsics.width), float(intrinsics.height)
    u, v = project(points_cam, intrinsics)
    return float(u.min()), float(v.min()), float(u.max()), float(v.max())


def shown_part(image: NDArray[np.uint8 | np.bool_], margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns of the pixels of an image [H, W] that are not 0, and `margin` more around them; empty where all are 0."""
    values = image.view(np.uint8)  # the greatest of a line is found faster than whether there is any
    rows = np.flatnonzero(values.max(axis=1))
    if not len(rows):
        return slice(0), slice(0)
    columns = np.flatnonzero(values[rows[0] : rows[-1] + 1].max(axis=0))
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    return slice(top, int(rows[-1]) + 1 + margin), slice(left, int(columns[-1]) + 1 + margin)


def image_coordinates(T_cam_obj: Pose, intrinsics: Intrinsics) -> tuple[int, int]:
    """The pixel of an object's origin, (-1, -1) where it is outside the image or behind the camera (dataset.md)."""
    x, y, z = T_cam_obj[:3, 3].tolist()
    if z <= 0.0:
        return -1, -1
    u, v = intrinsics.fx * x / z + intrinsics.cx, intrinsics.fy * y / z + intrinsics.cy
    if not (0.0 <= u < intrinsics.width and 0.0 <= v < intrinsics.height):
        return -1, -1
    return math.floor(u), math.floor(v)


def is_outside_views(points: Array, cameras: Sequence[Camera]) -> bool:
    """Whether the convex hull of points [N, 3], world, is certainly outside the image of every camera between these.

    The cameras have the same rotation and intrinsics, and stand for every camera on the lines between them. So each side
    of the image is one bundle of parallel planes, and the hull is outside where all points as seen from all cameras lie
    beyond one of them, or below every camera while the whole image looks up. False leaves it open.
    """
    k, rotation = cameras[0].intrinsics, cameras[0].T_world_cam[:3, :3]
    if (corner_rays(k) @ rotation[2] > 0.0).all():
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


def is_cut(corners: Array, k: Intrinsics) -> bool:
    """Whether the near plane cuts faces, corners [F, 3, 3] in the camera's frame: some are in the picture and nearer than it.

    By Sutherland and Hodgman 1974 against the sides of the picture, the camera's plane and the near plane.
    """
    planes = np.zeros((6, 4))
    planes[:5, :3], planes[5] = _side_normals(k), (0.0, 0.0, -1.0, NEAR_M)
    inside = corners @ planes[:, :3].T + planes[:, 3] > 0.0
    near = np.flatnonzero(np.all(inside.any(axis=1), axis=1))  # others have all corners on the outer side of one plane
    return any(len(_clip(corners[face], planes)) for face in near)


def _clip(polygon: Array, planes: Array) -> Array:
    """The corners [N, 3] of what of a polygon lies on the inner side of planes [P, 4], n p + d > 0."""
    for plane in planes:
        height = polygon @ plane[:3] + plane[3]
        kept = list[Array]()
        for n, (point, following) in enumerate(zip(polygon, np.roll(polygon, -1, axis=0), strict=True)):
            here, there = height[n], height[(n + 1) % len(polygon)]
            kept += [point] if here > 0.0 else []
            kept += [point + (following - point) * here / (here - there)] if (here > 0.0) != (there > 0.0) else []
        polygon = np.reshape(kept, (-1, 3))
    return polygon


def corner_rays(k: Intrinsics) -> Array:
    """[4, 3]: the rays through the image's corners, in the optical frame; every other is between them."""
    columns, rows = (-MARGIN_PX, k.width + MARGIN_PX), (-MARGIN_PX, k.height + MARGIN_PX)
    return np.array([[(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0] for v in rows for u in columns])


def spread_evenly(count: int, most: int) -> NDArray[np.int64]:
    """[min(count, most)] ascending: places of at most so many of `count` things; of two or more, the first and the last."""
    if count <= most:
        return np.arange(count, dtype=np.int64)
    return np.linspace(0, count - 1, most).round().astype(np.int64)
