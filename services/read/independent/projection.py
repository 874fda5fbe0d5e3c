"""Projection by its definition: the stored input cloud, point by point, in the mirror camera."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from services.read.independent.pair import ROUNDING, StoredPair, matrix, unproject

TIE_M = 1e-12
"""Two carried points as near to each other as this in z are tied: which is nearer is a matter of rounding."""

MOST_BROKEN_TIES = 0.25
"""Share of tied pixels that may show another point: rounding breaks some 4 %, another rule more than half."""


def check_projection(pair: StoredPair) -> Iterator[str]:
    """The stored input cloud in the mirror camera: pixel is floor(u, v), the nearest z wins, ties go to the lowest index."""
    source, target = pair.views["input"], pair.views["projected"]
    points, index = unproject(pair, source, np.True_)
    x, y, z, _ = np.linalg.inv(matrix(target, "T_world_cam")) @ matrix(source, "T_world_cam") @ points
    front = z > 0
    x, y, z, index = x[front], y[front], z[front], index[front]
    u, v = np.floor(target["fx"] * x / z + target["cx"]), np.floor(target["fy"] * y / z + target["cy"])
    inside = (u >= 0) & (u < target["width"]) & (v >= 0) & (v < target["height"])
    pixel, z, index = (v * target["width"] + u)[inside].astype(np.int64), z[inside], index[inside]
    order = np.lexsort((z, pixel))
    pixel, z, index = pixel[order], z[order], index[order]
    winner = np.flatnonzero(np.diff(pixel, prepend=-1))
    tied = z - np.repeat(z[winner], np.diff(winner, append=len(pixel))) <= TIE_M
    lowest = np.full(target["width"] * target["height"], np.iinfo(np.int64).max)
    np.minimum.at(lowest, pixel[tied], index[tied])
    depth, units = np.zeros(lowest.shape), target["depth_units_per_m"]
    depth[pixel[winner]] = z[winner]
    low, high = pair.job["images"]["depth_range_m"]
    stored = pair.images["projected", "depth"].ravel()
    if wrong := np.count_nonzero(stored != np.where((depth > low) & (depth < high), np.rint(depth * units), 0)):
        yield f"{wrong} depth pixels are not those of the input cloud"
    if abs(target["projected_filled_share"] - np.count_nonzero(stored) / stored.size) > ROUNDING:
        yield f"projected_filled_share is {target['projected_filled_share']}, and not the share of pixels with depth"
    if ("projected", "rgb") in pair.images and not pair.job["sensor"]["distortion"]:
        several = np.bincount(pixel[tied], minlength=len(lowest)) > 1
        yield from _check_colours(pair, np.where(depth > 0, lowest, -1), several)


def _check_colours(pair: StoredPair, source: NDArray[np.int64], several: NDArray[np.bool_]) -> Iterator[str]:
    """Colours of the source pixels (flat indices [H W], -1 for holes); `several` marks pixels whose nearest points tie."""
    colours = np.concatenate([pair.images["input", "rgb"].reshape(-1, 3), np.zeros((1, 3), np.uint8)])
    wrong = (colours[source] != pair.images["projected", "rgb"].reshape(-1, 3)).any(axis=1)
    if plain := np.count_nonzero(wrong & ~several):
        yield f"{plain} colours are not those of the nearest points"
    broken, ties = np.count_nonzero(wrong & several), np.count_nonzero(several)
    if broken > MOST_BROKEN_TIES * ties:
        yield f"{broken} of {ties} ties do not go to the lowest source index"
