"""What is asked of every pixel of an image: stored depth, colours carried along, extents of regions. Pure."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled


class Extent(NamedTuple):
    """How many pixels a region has, and their bounding box (x, y, width, height); all 0 where it has none."""

    pixels: int
    bbox_xywh: tuple[int, int, int, int]


def round_depth(depth_m: NDArray[np.floating], low_m: float, high_m: float, units_per_m: float) -> NDArray[np.uint16]:
    """[H, W] uint16: depth [H, W] in units, to the nearest (ties to even); 0 unless low < depth < high (0 for nan)."""
    units = np.empty(depth_m.shape, np.uint16)
    _round_depth(np.ascontiguousarray(depth_m).reshape(-1), low_m, high_m, units_per_m, units.reshape(-1))
    return units


@compiled
def _round_depth(depth_m: NDArray, low_m: float, high_m: float, units_per_m: float, units: NDArray[np.uint16]) -> None:
    for i in range(len(depth_m)):
        z = np.float64(depth_m[i])
        units[i] = np.uint16(np.rint(z * units_per_m)) if low_m < z < high_m else np.uint16(0)


def take_colours(rgb: NDArray[np.uint8], source: NDArray[np.integer]) -> NDArray[np.uint8]:
    """[H, W, 3] uint8: at each pixel the colour of the pixel of `rgb` whose flat index `source` [H, W] holds; -1 is black."""
    taken = np.zeros((*source.shape, 3), np.uint8)
    _take_colours(np.ascontiguousarray(rgb).reshape(-1, 3), source.reshape(-1), taken.reshape(-1, 3))
    return taken


@compiled
def _take_colours(rgb: NDArray[np.uint8], source: NDArray[np.integer], taken: NDArray[np.uint8]) -> None:
    for i in range(len(source)):
        if source[i] >= 0:
            for channel in range(3):
                taken[i, channel] = rgb[source[i], channel]


def measure_regions(region: NDArray[np.uint8]) -> list[Extent]:
    """The extent of each of the 256 region ids in a mask [H, W]."""
    counts, boxes = np.zeros(256, np.int64), np.zeros((256, 4), np.int64)
    boxes[:, :2] = max(region.shape)
    whole = np.ascontiguousarray(region)
    words = whole.view(np.uint64) if region.shape[1] % 8 == 0 else np.empty((len(region), 0), np.uint64)
    _measure_regions(whole, words, counts, boxes)
    return [
        Extent(count, (x, y, right - x, bottom - y)) if count else Extent(0, (0, 0, 0, 0))
        for count, (x, y, right, bottom) in zip(counts.tolist(), boxes.tolist(), strict=True)
    ]


@compiled
def _measure_regions(
    region: NDArray[np.uint8], words: NDArray[np.uint64], counts: NDArray[np.int64], boxes: NDArray[np.int64]
) -> None:
    """Runs of one id along a row are counted at once; boxes are left, top, right and bottom, the last two excluded.

    `words` are the same pixels eight at a time, or none.
    """
    height, width = region.shape
    for row in range(height):
        first = 0
        while first < width:
            region_id = region[row, first]
            stop = first + 1
            eight = np.uint64(region_id) * np.uint64(0x0101010101010101)
            while stop < width and region[row, stop] == region_id:
                if stop % 8 == 0 and stop // 8 < words.shape[1] and words[row, stop // 8] == eight:
                    stop += 8
                else:
                    stop += 1
            counts[region_id] += stop - first
            boxes[region_id, 0] = min(boxes[region_id, 0], first)
            boxes[region_id, 1] = min(boxes[region_id, 1], row)
            boxes[region_id, 2] = max(boxes[region_id, 2], stop)
            boxes[region_id, 3] = max(boxes[region_id, 3], row + 1)
            first = stop


def count_filled(projected: NDArray[np.uint16], seen: NDArray[np.uint16], behind: Array | float) -> tuple[int, int]:
    """(pixels that are not 0 in `projected`, those of them that lie more than `behind` units behind `seen`)."""
    return _count_filled(projected.reshape(-1), seen.reshape(-1), float(behind))


@compiled
def _count_filled(projected: NDArray[np.uint16], seen: NDArray[np.uint16], behind: float) -> tuple[int, int]:
    filled = hidden = 0
    for i in range(len(projected)):
        if projected[i] > 0:
            filled += 1
            if seen[i] > 0 and projected[i] > seen[i] + behind:
                hidden += 1
    return filled, hidden
