"""A view by ray at its own pixels' centres: what its stored depth and mask ought to be. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.camera import Camera
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import Placed
from services.study.measure.rays import cast_at, objects_of, project_box, sees
from workers.geometry.camera import unproject
from workers.geometry.frames import invert, transform
from workers.geometry.raycast import NEAR_M

Index = NDArray[np.int64]

SPREAD_PIXELS = 19_200
"""Of table and floor about so many pixels at most are cast, evenly over the image: a sixteenth of 640 x 480."""

SPREAD_SEED = 0x5B4EAD


@dataclass(frozen=True, eq=False)
class Seen:
    """What rays meet through the centres of some pixels of an image.

    rows [N], columns [N] int64; depth_m [N] float64, z along the optical axis, 0 where nothing is met; region [N] uint8.
    """

    rows: Index
    columns: Index
    depth_m: Array
    region: NDArray[np.uint8]

    def of(self, image: NDArray) -> NDArray:
        """[N, ...]: these pixels of an image [H, W, ...]."""
        return image[self.rows, self.columns]


@dataclass(frozen=True, eq=False)
class Pixels:
    """A view by ray at its own pixels: all in the box that objects can be seen in, and some evenly over the image."""

    box: Seen
    spread: Seen


def cast_pixels(things: Sequence[Placed], camera: Camera) -> Pixels:
    """A view at its own pixels' centres."""
    box = project_box(objects_of(things), camera) or (0.0, 0.0, 0.0, 0.0)
    left, top, right, bottom = math.floor(box[0]), math.floor(box[1]), math.ceil(box[2]), math.ceil(box[3])
    rows, columns = np.mgrid[top:bottom, left:right]
    inside = _cast_centres(things, camera, rows.ravel(), columns.ravel())
    return Pixels(inside, _cast_centres(things, camera, *_spread(camera.intrinsics.width, camera.intrinsics.height)))


@cache
def _spread(width: int, height: int) -> tuple[Index, Index]:
    """(rows, columns) of about `SPREAD_PIXELS` pixels: of each square of pixels one by chance, the same in every image.

    Not a grid: the pixels that a projection fills make a pattern of a few pixels, which a grid would fall in step with.
    """
    step = max(1, round(math.sqrt(width * height / SPREAD_PIXELS)))
    rows, columns = (corner.ravel() for corner in np.mgrid[0:height:step, 0:width:step])
    within = np.random.default_rng([SPREAD_SEED, width, height]).integers(step, size=(2, len(rows)))
    rows, columns = rows + within[0], columns + within[1]
    there = (rows < height) & (columns < width)
    return rows[there], columns[there]


def _cast_centres(things: Sequence[Placed], camera: Camera, rows: Index, columns: Index) -> Seen:
    u, v = columns.astype(np.float64) + 0.5, rows.astype(np.float64) + 0.5
    return Seen(rows, columns, *cast_at(things, camera, u, v))


def seen_by_other(things: Sequence[Placed], camera: Camera, seen: Seen, other: Camera) -> NDArray[np.bool_]:
    """[N] bool: whether the point of an object that each of the rays meets is seen in the other camera's image too."""
    mine = np.flatnonzero(seen.region >= REGION_FIRST_OBJECT)
    points = unproject(seen.rows[mine], seen.columns[mine], seen.depth_m[mine], camera.intrinsics)
    there = transform(invert(other.T_world_cam) @ camera.T_world_cam, points)
    before = there[:, 2] > NEAR_M
    mine, there = mine[before], there[before]
    both = np.zeros(len(seen.region), bool)
    both[mine] = sees(other, things, there)
    return both
