"""Views by rays in float64: at pixels' centres, at random places, and of the objects' patch. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import Camera
from workers.geometry.camera import NEAR_M, project, project_bounds, unproject
from workers.geometry.frames import invert, transform
from workers.geometry.raycast import first_hit

Box = tuple[float, float, float, float]
"""(left, top, right, bottom)."""

Index = NDArray[np.int64]

SAME_M = 1e-4
"""A ray to a point meets it where z is this near: half of a stored unit, and a hundred times the error of Embree's float32
rays at a grazing surface."""

SPREAD_PIXELS = 19_200
"""The most pixels, about, that are cast evenly over the image: a sixteenth of 640 x 480."""

SPREAD_SEED = 0x5B4EAD

DENSE = 256
"""Rays along each side of the box about the objects: 16 in a pixel and more while that box has at most 4,096 of a 640 x 480
image's pixels, as the objects of the built-in jobs have."""

BETWEEN = 4096
"""Rays at random in the objects' patch. A median of as many is off by 2 % of the spread."""

BETWEEN_SEED = 0x0B5E55ED
"""The random stream of those rays, which no job's seed reaches."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The hits of rays through the centres of some pixels of an image.

    rows [N], columns [N] int64; depth_m [N] float64, z along the optical axis, 0 without a hit; region [N] uint8.
    """

    rows: Index
    columns: Index
    depth_m: Array
    region: NDArray[np.uint8]

    def of(self, image: NDArray) -> NDArray:
        """[N, ...]: these pixels of an image [H, W, ...]."""
        return image[self.rows, self.columns]


class Pixels(NamedTuple):
    """A view by rays at its own pixels: all in the box that objects can be seen in, and some evenly over the image."""

    box: Seen
    spread: Seen


class Patch(NamedTuple):
    """The objects in a view by rays that do not depend on the image's size.

    front_m: least z of their visible points, inf where none is visible. box: (left, top, right, bottom) of the visible part
    in shares of the image's width and height, None where there is none. at [N, 2] float64: random places in the box,
    (across, down) in shares of the image; depth_m [N] and region [N] of the rays through these.
    """

    front_m: float
    box: Box | None
    at: Array
    depth_m: Array
    region: NDArray[np.uint8]


NOTHING = Patch(math.inf, None, np.empty((0, 2)), np.empty(0), np.empty(0, np.uint8))


class Eye:
    """A camera and the things of a scene in its frame, where Embree's float32 is finest."""

    def __init__(self, things: Sequence[Placed], camera: Camera) -> None:
        self.camera, self.k = camera, camera.intrinsics
        T_cam_world = invert(camera.T_world_cam)
        self.things = [Placed(thing.region_id, thing.shape, T_cam_world @ thing.T_world_shape) for thing in things]

    def cast(self, u: Array, v: Array) -> tuple[Array, NDArray[np.uint8]]:
        """(z [N] float64 metres, region [N] uint8) of the rays through image coordinates; 0 without a hit.

        Like `cast_view`, from the near plane on.
        """
        rays = np.stack([(u - self.k.cx) / self.k.fx, (v - self.k.cy) / self.k.fy, np.ones(len(u))], axis=1)
        hits = first_hit(self.things, NEAR_M * rays, rays)
        return np.where(np.isinf(hits.distance), 0.0, hits.distance + NEAR_M), hits.region

    def sees(self, points: Array) -> NDArray[np.bool_]:
        """[N] bool: whether surface points [N, 3] in the camera's frame, before it, are visible: the rays to them hit them."""
        u, v = project(points, self.k)
        z, region = self.cast(u, v)
        inside = (u >= 0.0) & (u < self.k.width) & (v >= 0.0) & (v < self.k.height)
        return inside & (region > 0) & (np.abs(z - points[:, 2]) <= SAME_M)

    def vertices(self) -> Array:
        """[V, 3] float64: the vertices of the objects, which are all things but floor and table."""
        objects = [thing for thing in self.things if thing.region_id >= REGION_FIRST_OBJECT]
        return np.concatenate(
            [np.empty((0, 3)), *(transform(one.T_world_shape, one.shape.vertices) for one in objects)]
        )

    def box(self) -> Box | None:
        """The box about the objects' projected vertices, pixels, cut to the image; None where it is outside.

        The whole image where a vertex is not in front of the near plane.
        """
        points = self.vertices()
        if not len(points):
            return None
        bounds = project_bounds(points, self.k, NEAR_M)
        left, top, right, bottom = np.clip(bounds, 0, [self.k.width, self.k.height] * 2).tolist()
        return (left, top, right, bottom) if left < right and top < bottom else None


def cast_pixels(things: Sequence[Placed], camera: Camera) -> Pixels:
    """A view at its own pixels' centres."""
    eye = Eye(things, camera)
    left, top, right, bottom = eye.box() or (0.0, 0.0, 0.0, 0.0)
    rows, columns = np.mgrid[math.floor(top) : math.ceil(bottom), math.floor(left) : math.ceil(right)]
    places = (rows.ravel(), columns.ravel()), _spread(eye.k.width, eye.k.height)
    return Pixels(*(Seen(v, u, *eye.cast(u.astype(float) + 0.5, v.astype(float) + 0.5)) for v, u in places))


@cache
def _spread(width: int, height: int) -> tuple[Index, Index]:
    """(rows, columns) of about `SPREAD_PIXELS` pixels: one at random in each square of pixels, the same in every image.

    A grid would fall in step with the pattern of pixels that a projection fills.
    """
    step = max(1, round(math.sqrt(width * height / SPREAD_PIXELS)))
    rows, columns = (corner.ravel() for corner in np.mgrid[0:height:step, 0:width:step])
    within = np.random.default_rng([SPREAD_SEED, width, height]).integers(step, size=(2, len(rows)))
    rows, columns = rows + within[0], columns + within[1]
    there = (rows < height) & (columns < width)
    return rows[there], columns[there]


def cast_patch(things: Sequence[Placed], camera: Camera, *names: int) -> Patch:
    """The objects in a view; `names` seed the random rays: the scene and the pair."""
    eye = Eye(things, camera)
    reach = eye.box()
    if reach is None:
        return NOTHING
    left, top, right, bottom = reach
    cell = ((right - left) / DENSE, (bottom - top) / DENSE)
    rows, columns = (index.ravel() for index in np.mgrid[0:DENSE, 0:DENSE])
    depth_m, region = eye.cast(left + cell[0] * (columns + 0.5), top + cell[1] * (rows + 0.5))
    mine = region >= REGION_FIRST_OBJECT
    if not mine.any():
        return NOTHING
    rows, columns, dense_m = rows[mine], columns[mine], float(depth_m[mine].min())
    # A flat face is nearest at a vertex, so the visible vertices before the dense rays' hits are tried as well.
    points = eye.vertices()
    points = points[(points[:, 2] > NEAR_M) & (points[:, 2] < dense_m)]
    front_m = float(points[eye.sees(points), 2].min(initial=dense_m))
    across = (left + cell[0] * np.array([columns.min(), columns.max() + 1])) / eye.k.width
    down = (top + cell[1] * np.array([rows.min(), rows.max() + 1])) / eye.k.height
    rng = np.random.default_rng([BETWEEN_SEED, *names])
    at = rng.uniform((across[0], down[0]), (across[1], down[1]), (BETWEEN, 2))
    box = (float(across[0]), float(down[0]), float(across[1]), float(down[1]))
    return Patch(front_m, box, at, *eye.cast(at[:, 0] * eye.k.width, at[:, 1] * eye.k.height))


def seen_by_other(things: Sequence[Placed], camera: Camera, seen: Seen, other: Camera) -> NDArray[np.bool_]:
    """[N] bool: whether the object point that each ray hits is visible in the other camera's image too."""
    mine = np.flatnonzero(seen.region >= REGION_FIRST_OBJECT)
    points = unproject(seen.rows[mine], seen.columns[mine], seen.depth_m[mine], camera.intrinsics)
    there = transform(invert(other.T_world_cam) @ camera.T_world_cam, points)
    before = there[:, 2] > NEAR_M
    both = np.zeros(len(seen.region), bool)
    both[mine[before]] = Eye(things, other).sees(there[before])
    return both
