"""How several objects begin without touching: each on a place of its own, or one above another. Pure."""

import math
from collections.abc import Sequence

import numpy as np

from schemas.base import Array, frozen_array
from schemas.scene.plan import ObjectStart
from workers.geometry.frames import transform

APART_M = 0.001
"""Columns nearer to each other than this count as touching."""

_HALF_TURN = [math.pi * step / 90 for step in range(90)]
ACROSS = frozen_array([[math.cos(angle), math.sin(angle)] for angle in _HALF_TURN])
"""[90, 2] the directions in which a gap is looked for. Two footprints of 0.2 m that lie apart by more than 4 mm have
one among them, as none is further than 1 degree from the best."""


def points_of(start: ObjectStart) -> Array:
    """[N, 3] world: the corners of an object's hull where it begins."""
    return transform(start.T_world_obj, start.hull.vertices)


def columns_apart(points: Array, others: Array) -> bool:
    """Whether a vertical plane stands between two clouds [N, 3], at least `APART_M` of air wide.

    Sufficient for two bodies that fall straight down not to meet, and no more is asked: by the theorem of the separating
    axis, applied to `ACROSS`, clouds that almost touch may count as touching.
    """
    mine, theirs = points[:, :2] @ ACROSS.T, others[:, :2] @ ACROSS.T
    gap = np.maximum(theirs.min(axis=0) - mine.max(axis=0), mine.min(axis=0) - theirs.max(axis=0))
    return bool(gap.max() >= APART_M)


def has_room(points: Array, earlier: Sequence[ObjectStart]) -> bool:
    """Whether a cloud [N, 3] stands in no earlier object's column."""
    return all(columns_apart(points, points_of(other)) for other in earlier)


def rise_above(points: Array, earlier: Sequence[ObjectStart]) -> float:
    """Metres by which a cloud [N, 3] must be lifted so that its lowest point is level with the top of all earlier objects."""
    top = max(float(points_of(other)[:, 2].max()) for other in earlier)
    return max(0.0, top - float(points[:, 2].min()))
