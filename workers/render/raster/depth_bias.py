"""Depth bias by region, so that the lowest region id wins among coplanar faces. Pure."""

from collections.abc import Sequence

import numpy as np

from schemas.base import Array
from schemas.scene.scene import Placed
from workers.geometry.frames import transform

NEAR_M = 1e-3
"""Things whose bounding boxes are farther apart than this share no face."""


def rank_regions(things: Sequence[Placed], corners: Sequence[Array]) -> dict[int, int]:
    """The rank of each region: one more than that of any region of a lower id that it may share a face with.

    corners: those of each thing's bounding box [8, 3] in its own frame. Only things whose boxes meet can have coplanar faces
    at one place: twenty objects side by side all have the rank of a single one.
    """
    boxes: dict[int, tuple[Array, Array]] = {}
    for thing, box in zip(things, corners, strict=True):
        placed = transform(thing.T_world_shape, box)
        low, high = boxes.get(thing.region_id, (placed[0], placed[0]))
        boxes[thing.region_id] = np.minimum(low, placed.min(axis=0)), np.maximum(high, placed.max(axis=0))
    regions = sorted(boxes)
    low, high = (np.array([boxes[region][k] for region in regions]).reshape(-1, 3) for k in (0, 1))
    before = (low[:, None] < high[None] + NEAR_M).all(axis=2)
    meets = np.logical_and(before, before.T)
    ranks = np.zeros(len(regions), np.int64)
    for number in range(1, len(regions)):
        ranks[number] = (1 + ranks[:number][meets[number, :number]]).max(initial=0)
    return dict(zip(regions, ranks.tolist(), strict=True))
