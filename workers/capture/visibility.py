"""Which points of a mesh the cameras can see past the mesh itself, by rays."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Mesh, Part, Shape
from schemas.scene.view import Camera
from workers.geometry.camera import project
from workers.geometry.frames import invert, transform
from workers.geometry.projection import in_frame
from workers.geometry.raycast import first_hit

CLEAR_M = 1e-5
"""A point is lifted off its face by so much before it is looked at, above float32's steps in the ray caster."""


UNSEEN = -2.0
"""Stands for the cosine of a point that is not in the image."""


def visible_points(
    mesh: Mesh,
    points: Array,
    normals: Array,
    cameras: Sequence[Camera],
    clear_m: float = CLEAR_M,
    least_cos: float = 0.0,
) -> NDArray[np.bool_]:
    """[N] bool: points [N, 3] that a camera sees past the mesh, lifted along their unit normals by `clear_m`.

    A camera counts where the cosine between the normal and the way to it is above `least_cos`: 0 for any angle from outside.
    """
    visible = np.zeros(len(points), np.bool_)
    if not len(points) or not len(cameras):
        return visible
    positions = np.array([camera.position for camera in cameras])
    cosine = np.stack([facing_cosine(points, normals, camera) for camera in cameras])
    order = np.argsort(-cosine, axis=0, kind="stable")
    first = 0
    # The ray caster builds its tree at each call: few calls, the cameras that face a point most first.
    for stop in (1, 4, len(cameras)):
        point = np.repeat(np.flatnonzero(~visible), max(min(stop, len(cameras)) - first, 0))
        if len(point):
            place = np.tile(np.arange(first, min(stop, len(cameras))), int((~visible).sum()))
            camera_of = order[place, point]
            asked = cosine[camera_of, point] > least_cos
            point, camera_of = point[asked], camera_of[asked]
            origins = points[point] + clear_m * normals[point]
            hits = first_hit([placed(mesh)], origins, positions[camera_of] - origins)
            visible[point[hits.distance > 1.0]] = True
        first = stop
    return visible


def facing_cosine(points: Array, normals: Array, camera: Camera) -> Array:
    """[N] cosine between the normal of points [N, 3] and the way to a camera, `UNSEEN` where they are not in its image."""
    seen = transform(invert(camera.T_world_cam), points)
    front = seen[:, 2] > 0.05
    u, v = project(np.where(front[:, None], seen, [0.0, 0.0, 1.0]), camera.intrinsics)
    towards = camera.position - points
    cosine = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
    return np.where(front & in_frame(u, v, camera.intrinsics), cosine, UNSEEN)


def placed(mesh: Mesh) -> Placed:
    """The mesh as the ray caster takes it, in the frame that it is in."""
    return Placed(REGION_FIRST_OBJECT, Shape((Part("mesh", mesh.vertices, mesh.faces),)), np.eye(4))
