"""Rays through any place of an image, and where in it objects can be seen. Pure; float64, by workers/geometry/raycast.py."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.camera import Camera
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import Placed
from workers.geometry.camera import project, project_bounds
from workers.geometry.frames import invert, transform
from workers.geometry.raycast import NEAR_M, RAYS_AT_ONCE, first_hit

Box = tuple[float, float, float, float]
"""(left, top, right, bottom)."""

SAME_M = 1e-4
"""A ray to a point meets it where z is this near: half of a stored unit, and a hundred times what Embree's float32 rays
miss a grazing surface by."""


def objects_of(things: Sequence[Placed]) -> list[Placed]:
    """All but floor and table."""
    return [thing for thing in things if thing.region_id >= REGION_FIRST_OBJECT]


def project_box(things: Sequence[Placed], camera: Camera) -> Box | None:
    """The box about the projected vertices, pixels, cut to the image; None where it is outside.

    The whole image where a vertex is not in front of the near plane.
    """
    k = camera.intrinsics
    points = vertices_in(things, camera)
    if not len(points):
        return None
    bounds = project_bounds(points, k, NEAR_M)
    left, top, right, bottom = np.clip(bounds, 0, [k.width, k.height] * 2).tolist()
    return (left, top, right, bottom) if left < right and top < bottom else None


def vertices_in(things: Sequence[Placed], camera: Camera) -> Array:
    """[V, 3] float64: the vertices of things in the camera's frame."""
    T_cam_world = invert(camera.T_world_cam)
    parts = [transform(T_cam_world @ thing.T_world_shape, thing.shape.vertices) for thing in things]
    return np.concatenate([np.empty((0, 3)), *parts])


def cast_at(things: Sequence[Placed], camera: Camera, u: Array, v: Array) -> tuple[Array, NDArray[np.uint8]]:
    """(z [N] float64 metres, region [N] uint8) of the rays through image coordinates; 0 where nothing is met.

    As `cast_view` does: in the camera's frame, where Embree's float32 is finest, and from the near plane on.
    """
    k, T_cam_world = camera.intrinsics, invert(camera.T_world_cam)
    there = [Placed(thing.region_id, thing.shape, T_cam_world @ thing.T_world_shape) for thing in things]
    depth_m, region = np.zeros(len(u)), np.zeros(len(u), np.uint8)
    for first in range(0, len(u), RAYS_AT_ONCE):
        some = slice(first, first + RAYS_AT_ONCE)
        x, y = (u[some] - k.cx) / k.fx, (v[some] - k.cy) / k.fy
        rays = np.stack([x, y, np.ones(len(x))], axis=1)
        hits = first_hit(there, NEAR_M * rays, rays)
        depth_m[some] = np.where(np.isinf(hits.distance), 0.0, hits.distance + NEAR_M)
        region[some] = hits.region
    return depth_m, region


def sees(camera: Camera, things: Sequence[Placed], points: Array) -> NDArray[np.bool_]:
    """[N] bool: whether the camera sees points [N, 3] of surfaces, in its frame and before it: the rays to them meet them."""
    k = camera.intrinsics
    u, v = project(points, k)
    z, region = cast_at(things, camera, u, v)
    inside = (u >= 0.0) & (u < k.width) & (v >= 0.0) & (v < k.height)
    return inside & (region > 0) & (np.abs(z - points[:, 2]) <= SAME_M)
