"""The pairs of a split, and what a network may know of one before it sees the mirror view.

Everything lies in a crop of the mirror image about the place where the object's seen points fall. Nothing but the input
view, the two cameras and the planes of table top and floor goes into it: the mirror view is the answer alone.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull

from schemas.job.assets import Split
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_TABLE
from services.dataset.dataset import Dataset
from services.dataset.pair import Pair
from services.dataset.view import Pixels, View
from workers.geometry import camera


def pairs_of_split(dataset: Dataset, split: Split, splits: Mapping[str, str] | None = None) -> Iterator[Pair]:
    """Every pair whose objects are all of instances of this split.

    `splits`: by instance; by default the column of `assets`, which follows from the instance's id and is the same in every
    dataset. `dataset.splits()` has the shares in each category. A scene of several objects of different splits is in none.
    """
    if splits is None:
        rows = dataset.table("assets").to_table(columns=["instance_id", "split"]).to_pylist()
        splits = {row["instance_id"]: row["split"] for row in rows}
    for pair in dataset.pairs(
        pc.field("instance_id").isin(pa.array([name for name in splits if splits[name] == split], pa.string()))
    ):
        if all(splits[name] == split for name in instances_of(pair)):
            yield pair


def instances_of(pair: Pair) -> set[str]:
    """The ids of all objects of a pair's scene."""
    return {pair.instance_id, *(body["instance_id"] for body in pair.scene["bodies"] or ())}


CROP = (96, 128)
"""Rows and columns, as the article's patches."""
SCALE_M = 0.1
"""Depths are given to the network relative to the object's seen points, in this unit."""
CHANNELS = 11

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Example:
    """One pair in the crop; images [H, W] float32 in metres unless said otherwise.

    features [C, H, W]; background: the planes of table top and floor. Truth: depth, 0 where unknown; mask [H, W] bool, the
    object. `middle_m`: the depth that features count from. `corner`: row and column of the crop's first pixel in the mirror
    image.
    """

    features: Image
    background: Image
    depth: Image
    mask: NDArray[np.bool_]
    middle_m: float
    corner: tuple[int, int]


def make_example(pair: Pair, region: int = REGION_FIRST_OBJECT) -> Example | None:
    """The example of an object of a pair; None where so few of its points are seen, or so near the rim, that there is no crop."""
    view, mirror = pair.input, pair.mirror
    assert mirror is not None
    depth, rgb = view.depth_m(), view.rgb()
    here = view.segment() == region
    T = np.linalg.inv(mirror.T_world_cam) @ view.T_world_cam
    cloud = transform(T, unproject(view, depth, here))
    if len(cloud) < 20:
        return None
    corner = crop_corner(mirror, cloud)
    if corner is None:
        return None
    up = mirror.T_world_cam[2, :3]
    turned = half_turn(cloud, up)
    middle = float(np.median(cloud[:, 2]))
    background, gap = put_planes(pair, mirror, corner)
    seen, other = (close_holes(splat(mirror, points, corner)) for points in (cloud, turned))
    color = splat_values(mirror, cloud, rgb[here & (depth > 0)], corner)
    features = stack_features(seen, other, background, color, gap, middle)
    window = np.s_[corner[0] : corner[0] + CROP[0], corner[1] : corner[1] + CROP[1]]
    truth, mask = mirror.depth_m()[window], mirror.segment()[window] == region
    return Example(features, background, truth, mask, middle, corner)


def unproject(view: Pixels, depth: Image, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """[N, 3] points in the camera's frame, metres, of the chosen pixels that have depth."""
    rows, columns = np.nonzero(chosen & (depth > 0))
    return camera.unproject(rows, columns, depth[rows, columns].astype(np.float64), view.camera.intrinsics)


def transform(T: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 3] points in the other frame."""
    return points @ T[:3, :3].T + T[:3, 3]


def pixels_of(view: Pixels, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(row, column) of the pixels that points in the camera's frame fall into."""
    u, v, _ = view.K @ (points / points[:, 2:]).T
    return np.floor(v).astype(int), np.floor(u).astype(int)


def crop_corner(view: View, points: NDArray[np.float64]) -> tuple[int, int] | None:
    """(row, column) of the crop's first pixel, None where the crop leaves the image."""
    rows, columns = pixels_of(view, points)
    k = view.camera.intrinsics
    top, left = (
        int((both.min() + both.max() + 1 - size) // 2) for both, size in zip((rows, columns), CROP, strict=True)
    )
    inside = top >= 0 and left >= 0 and top + CROP[0] <= k.height and left + CROP[1] <= k.width
    return (top, left) if inside else None


def splat(view: View, points: NDArray[np.float64], corner: tuple[int, int]) -> Image:
    """The nearest depth of points that fill 3 x 3 pixels each, 0 where there is none."""
    image = np.full(CROP, np.inf, np.float32)
    rows, columns = pixels_of(view, points)
    for dy, dx in np.ndindex(3, 3):
        y, x = rows - corner[0] + dy - 1, columns - corner[1] + dx - 1
        inside = (y >= 0) & (x >= 0) & (y < CROP[0]) & (x < CROP[1])
        np.minimum.at(image, (y[inside], x[inside]), points[inside, 2].astype(np.float32))
    return np.where(np.isfinite(image), image, np.float32(0))


def splat_values(view: View, points: NDArray, values: NDArray, corner: tuple[int, int]) -> Image:
    """[H, W, 3] colour, 0 to 1, of the nearest points; 0 where there is none."""
    image = np.zeros((*CROP, 3), np.float32)
    rows, columns = pixels_of(view, points)
    order = np.argsort(-points[:, 2], kind="stable")
    for dy, dx in np.ndindex(3, 3):
        y, x = rows[order] - corner[0] + dy - 1, columns[order] - corner[1] + dx - 1
        inside = (y >= 0) & (x >= 0) & (y < CROP[0]) & (x < CROP[1])
        image[y[inside], x[inside]] = values[order][inside] / 255
    return image


def close_holes(depth: Image) -> Image:
    """Depth with gaps up to a few pixels, and holes inside the outline, filled from the nearest pixel."""
    known = depth > 0
    closed = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(known, 8), iterations=4))[8:-8, 8:-8] | known
    if not known.any():
        return depth
    _, (rows, columns) = ndimage.distance_transform_edt(~known, return_indices=True)
    return np.where(closed, depth[rows, columns], np.float32(0))


def nearest(*layers: Image) -> Image:
    """The nearest known depth of several images; 0 is unknown."""
    depth = np.min([np.where(layer > 0, layer, np.inf) for layer in layers], axis=0)
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def plane_depth(mirror: View, height_m: float, corner: tuple[int, int]) -> Image:
    """Depth of the level plane at this height in the world, 0 where the rays miss it."""
    rays = crop_rays(mirror, corner) @ mirror.T_world_cam[:3, :3].T
    z = (height_m - mirror.T_world_cam[2, 3]) / rays[:, 2].reshape(CROP)
    return np.where(z > 0, z, 0).astype(np.float32)


def crop_rays(mirror: View, corner: tuple[int, int]) -> NDArray[np.float64]:
    """[H * W, 3] rays with z = 1 through the centres of the crop's pixels, in the camera's frame."""
    rows, columns = np.indices(CROP).reshape(2, -1)
    ones = np.ones(len(rows))
    return camera.unproject(rows + corner[0], columns + corner[1], ones, mirror.camera.intrinsics)


def table_top(pair: Pair) -> tuple[float, NDArray[np.float64]]:
    """(height of the table top, [E, 3] its convex outline as a x + b y + c <= 0): the known plane, in the world."""
    vertices = pair.mesh(REGION_TABLE).vertices
    height = float(vertices[:, 2].max())
    return height, ConvexHull(vertices[vertices[:, 2] > height - 1e-4, :2]).equations


def put_planes(pair: Pair, mirror: View, corner: tuple[int, int]) -> tuple[Image, Image]:
    """(depth of the table top inside its outline and of the floor elsewhere, how much nearer the table's plane is)."""
    height, outline = table_top(pair)
    table, floor = plane_depth(mirror, height, corner), plane_depth(mirror, 0.0, corner)
    hits = transform(mirror.T_world_cam, crop_rays(mirror, corner) * table.reshape(-1, 1))
    inside = (hits[:, :2] @ outline[:, :2].T + outline[:, 2] <= 1e-6).all(axis=1).reshape(CROP)
    return np.where(inside & (table > 0), table, floor), floor - table


def planes(pair: Pair) -> Image:
    """[H, W] depth of table top and floor in the mirror view, metres."""
    assert pair.mirror is not None
    k = pair.mirror.camera.intrinsics
    depth_m = np.zeros((k.height, k.width), np.float32)
    rows, columns = CROP
    for row, column in product(range(0, k.height, rows), range(0, k.width, columns)):
        here = depth_m[row : row + rows, column : column + columns]
        here[:] = put_planes(pair, pair.mirror, (row, column))[0][: here.shape[0], : here.shape[1]]
    return depth_m


def half_turn(points: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points turned by 180 degrees about a vertical axis, as if the object were as deep as it is wide.

    The seen half is the one away from the mirror camera, so the axis lies half a width nearer to that camera.
    """
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    forward /= np.linalg.norm(forward)
    right = np.cross(up, forward)
    across, along = points @ right, points @ forward
    front = np.percentile(along, 98)
    width = np.ptp(np.percentile(across, [1, 99]))
    axis = right * (across.min() + across.max()) / 2 + forward * (front - width / 2)
    level = points - np.outer(points @ up, up)
    return points - 2 * level + 2 * (axis - (axis @ up) * up)


def stack_features(seen: Image, other: Image, background: Image, color: Image, gap: Image, middle: float) -> Image:
    """[CHANNELS, H, W]: depths relative to `middle`, which pixels have them, colour, and the place in the crop."""
    relative = [np.where(depth > 0, (depth - middle) / SCALE_M, 0) for depth in (seen, other)]
    plane = np.clip((background - middle) / SCALE_M, -5, 5)
    rows, columns = np.meshgrid(np.linspace(-1, 1, CROP[0]), np.linspace(-1, 1, CROP[1]), indexing="ij")
    maps = [*relative, seen > 0, other > 0, plane, gap - 1, rows, columns, *np.moveaxis(color, -1, 0)]
    return np.stack(maps).astype(np.float32)
