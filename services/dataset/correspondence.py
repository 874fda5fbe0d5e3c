"""Where the pixels of one view lie in another, and whether they are seen there, from the stored images of both. Pure."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.camera import project, unproject
from workers.geometry.frames import invert, transform

if TYPE_CHECKING:
    from services.dataset.view import Pixels


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Where every pixel of one image lies in another.

    uv [H, W, 2] float64: image coordinates there, pixels, the centre of the first pixel at (0.5, 0.5), also outside of the
    image; nan where the pixel has no depth, or lies behind the other camera. visible [H, W] bool: whether the other camera
    sees the same point.
    """

    uv: Array
    visible: NDArray[np.bool_]

    def flow(self) -> Array:
        """[H, W, 2] float64: `uv` minus the pixel's own centre, pixels."""
        rows, columns = np.indices(self.visible.shape)
        return self.uv - np.stack([columns + 0.5, rows + 0.5], axis=2)


def correspond(source: "Pixels", target: "Pixels", tolerance_m: float) -> Correspondence:
    """The source's stored depth carried into the target, and compared there with the target's.

    A point is seen where the pixel that it falls in shows its region, and where it lies no more than `tolerance_m` behind
    what `farthest_surface` expects there.
    """
    units, region = source.depth(), source.segment()
    rows, columns = np.nonzero(units)
    z = units[rows, columns] / source.depth_units_per_m
    found, seen = carry(source, target, rows, columns, z, region[rows, columns], tolerance_m)
    uv, visible = np.full((*units.shape, 2), np.nan), np.zeros(units.shape, np.bool_)
    uv[rows, columns], visible[rows, columns] = found, seen
    return Correspondence(uv, visible)


def carry(
    source: "Pixels",
    target: "Pixels",
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    z_m: Array,
    region: NDArray[np.uint8],
    tolerance_m: float,
) -> tuple[Array, NDArray[np.bool_]]:
    """(uv [N, 2], visible [N]) as in `Correspondence`, of N pixels of the source with depth z_m [N] and these regions [N]."""
    T_target_source = invert(target.T_world_cam) @ source.T_world_cam
    points = transform(T_target_source, unproject(rows, columns, z_m, source.camera.intrinsics))
    uv, visible = np.full((len(points), 2), np.nan), np.zeros(len(points), np.bool_)
    ahead = np.flatnonzero(points[:, 2] > 0.0)
    k, there = target.camera.intrinsics, target.segment()
    u, v = project(points[ahead], k)
    uv[ahead, 0], uv[ahead, 1] = u, v
    inside = (u >= 0.0) & (u < k.width) & (v >= 0.0) & (v < k.height)
    inside[inside] = there[v[inside].astype(np.int64), u[inside].astype(np.int64)] == region[ahead[inside]]
    if inside.any():
        at, u, v = ahead[inside], u[inside], v[inside]
        # Only the part of the image about these pixels: an object has one pixel in a hundred.
        top, left = max(int(v.min()) - 2, 0), max(int(u.min()) - 2, 0)
        near = slice(top, int(v.max()) + 3), slice(left, int(u.max()) + 3)
        depth_m = target.depth()[near] / target.depth_units_per_m
        visible[at] = points[at, 2] <= tolerance_m + farthest_surface(depth_m, there[near], u - left, v - top, k.fx)
    return uv, visible


def farthest_surface(depth_m: Array, region: NDArray[np.uint8], u: Array, v: Array, focal_px: float) -> Array:
    """[N] float64: how far away, metres, the surface may be that is seen at image coordinates u, v [N] inside of an image.

    depth_m, region [H, W]; -inf where the pixel has no depth. On a plane 1/z is linear in the image, so it is carried on
    from the pixel's centre by the steps to the next pixels along row and column. Where the surface bends between pixels,
    that may be wrong by as much as the steps differ: the lesser of the differences before and after, as much as a fold of
    two planes makes; none beside another region, and at most one pixel's width at that depth, so that an outline nearby does
    not count as a bend.
    """
    inverse = np.pad(
        np.divide(1.0, depth_m, out=np.full(depth_m.shape, np.nan), where=depth_m > 0.0), 2, constant_values=np.nan
    )
    label = np.pad(region, 2)
    row, column = np.floor(v).astype(np.int64), np.floor(u).astype(np.int64)
    own, here = region[row, column], inverse[row + 2, column + 2]
    there, bend = here.copy(), np.zeros(len(u))
    for off, down, right in ((v - row - 0.5, 1, 0), (u - column - 0.5, 0, 1)):
        side = np.where(off < 0.0, -1, 1)
        before, after, beyond = (
            np.where(label[at] == own, inverse[at], np.nan)
            for at in ((row + 2 + n * side * down, column + 2 + n * side * right) for n in (-1, 1, 2))
        )
        last, step, following = here - before, after - here, beyond - after
        there += np.abs(off) * np.nan_to_num(np.where(np.isnan(step), last, step))
        bend += np.nan_to_num(np.minimum(np.abs(step - last), np.abs(following - step)))
    z = 1.0 / there
    return np.nan_to_num(z + np.minimum(bend * z * z, z / focal_px), nan=-np.inf)
