"""How far each thing of a scene stands back, so that of coplanar faces the lowest region id wins. Pure."""

from collections.abc import Sequence

import numpy as np

from schemas.base import Array
from schemas.scene.scene import Placed
from workers.geometry.frames import transform

NEAR_M = 1e-3
"""Things whose boxes are no nearer than this share no face."""


def rank_regions(things: Sequence[Placed], corners: Sequence[Array]) -> dict[int, int]:
    """Steps by which each region stands back: one more than any region of a lower id that it may share a face with.

    corners: of each thing, those of its bounding box [8, 3] in its own frame. Only things whose boxes meet can have faces
    in one plane at one place; of twenty objects side by side all stand back as far as one alone does.
    """
    boxes: dict[int, tuple[Array, Array]] = {}
    for thing, box in zip(things, corners, strict=True):
        placed = transform(thing.T_world_shape, box)
        low, high = boxes.get(thing.region_id, (placed[0], placed[0]))
        boxes[thing.region_id] = np.minimum(low, placed.min(axis=0)), np.maximum(high, placed.max(axis=0))
    regions = sorted(boxes)
    if not regions:
        return {}
    low, high = (np.array([boxes[region][k] for region in regions]) for k in (0, 1))
    before = (low[:, None] < high[None] + NEAR_M).all(axis=2)
    meets = np.logical_and(before, before.T)
    ranks = np.zeros(len(regions), np.int64)
    for number in range(1, len(regions)):
        below = ranks[:number][meets[number, :number]]
        ranks[number] = 1 + below.max() if len(below) else 0
    return {region: int(rank) for region, rank in zip(regions, ranks, strict=True)}
