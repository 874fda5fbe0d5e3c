"""The objects in a view by rays that no image's pixels decide: their front, their outline, depth anywhere. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.camera import Camera
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import Placed
from services.study.measure.rays import Box, cast_at, objects_of, project_box, sees, vertices_in
from workers.geometry.raycast import NEAR_M

DENSE = 256
"""Rays about the objects for their front and their outline, along each side of the box about them: 16 in a pixel and more
while that box has at most 4,096 of a 640 x 480 image's pixels, as the objects of the built-in jobs have."""

BETWEEN = 4096
"""Rays at random in the objects' patch. A median of as many is off by 2 % of the spread."""

BETWEEN_SEED = 0x0B5E55ED
"""Of those rays: a stream of their own, which no job's seed reaches."""


@dataclass(frozen=True, eq=False)
class Patch:
    """The objects in a view, by rays that do not depend on how many pixels its image has.

    front_m: least z of what is seen of them, inf where nothing is. box: what is seen of them, (left, top, right, bottom) in
    shares of the image's width and height, None where nothing is. at [N, 2] float64: places at random in it, (across, down)
    in shares of the image; depth_m [N] and region [N] of the rays through these.
    """

    front_m: float
    box: Box | None
    at: Array
    depth_m: Array
    region: NDArray[np.uint8]


def cast_patch(things: Sequence[Placed], camera: Camera, *names: int) -> Patch:
    """The objects in a view; the rays at random are those of `names`: the scene and the pair."""
    k = camera.intrinsics
    nothing = Patch(math.inf, None, np.empty((0, 2)), np.empty(0), np.empty(0, np.uint8))
    reach = project_box(objects_of(things), camera)
    if reach is None:
        return nothing
    left, top, right, bottom = reach
    cell = ((right - left) / DENSE, (bottom - top) / DENSE)
    rows, columns = (index.ravel() for index in np.mgrid[0:DENSE, 0:DENSE])
    depth_m, region = cast_at(things, camera, left + cell[0] * (columns + 0.5), top + cell[1] * (rows + 0.5))
    mine = region >= REGION_FIRST_OBJECT
    if not mine.any():
        return nothing
    rows, columns, depth_m = rows[mine], columns[mine], depth_m[mine]
    front_m = _nearest_seen(things, camera, float(depth_m.min()))
    across = (left + cell[0] * np.array([columns.min(), columns.max() + 1])) / k.width
    down = (top + cell[1] * np.array([rows.min(), rows.max() + 1])) / k.height
    rng = np.random.default_rng([BETWEEN_SEED, *names])
    at = rng.uniform((across[0], down[0]), (across[1], down[1]), (BETWEEN, 2))
    z, hit = cast_at(things, camera, at[:, 0] * k.width, at[:, 1] * k.height)
    return Patch(front_m, (float(across[0]), float(down[0]), float(across[1]), float(down[1])), at, z, hit)


def _nearest_seen(things: Sequence[Placed], camera: Camera, dense_m: float) -> float:
    """Least z of what is seen of the objects, from the least of the dense rays: a flat face is nearest at a vertex.

    So the vertices before `dense_m` that the camera sees are tried as well.
    """
    points = vertices_in(objects_of(things), camera)
    points = points[(points[:, 2] > NEAR_M) & (points[:, 2] < dense_m)]
    return float(points[sees(camera, things, points), 2].min(initial=dense_m))
