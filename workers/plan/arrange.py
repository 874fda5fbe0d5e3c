"""How several objects begin without touching: each on a place of its own, or one above another. Pure."""

import math
from collections.abc import Sequence

import numpy as np

from schemas.base import Array, frozen_array
from schemas.scene.plan import ObjectStart
from workers.geometry.frames import transform

APART_M = 0.001
"""Columns nearer to each other than this count as touching."""

_ANGLES = math.pi * np.arange(90) / 90
AXES = frozen_array(np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1))
"""[90, 2] the horizontal axes that are tried for a separating plane. None is further than 1 degree from the best one, so
that two footprints of 0.2 m that are more than 4 mm apart are found to be so."""


def points_of(start: ObjectStart) -> Array:
    """[N, 3] world: the corners of an object's hull where it begins."""
    return transform(start.T_world_obj, start.hull.vertices)


def columns_apart(points: Array, others: Array) -> bool:
    """Whether a vertical plane separates two clouds [N, 3] by at least `APART_M` of air.

    Two bodies that fall straight down then do not meet. The theorem of the separating axis, applied to `AXES` alone:
    clouds that almost touch may count as touching.
    """
    mine, theirs = points[:, :2] @ AXES.T, others[:, :2] @ AXES.T
    gap = np.maximum(theirs.min(axis=0) - mine.max(axis=0), mine.min(axis=0) - theirs.max(axis=0))
    return bool(gap.max() >= APART_M)


def has_room(points: Array, earlier: Sequence[ObjectStart]) -> bool:
    """Whether a cloud [N, 3] stands in no earlier object's column."""
    return all(columns_apart(points, points_of(other)) for other in earlier)


def rise_above(points: Array, earlier: Sequence[ObjectStart]) -> float:
    """Metres by which a cloud [N, 3] must be lifted for its lowest point to be level with the top of all earlier objects."""
    top = max(float(points_of(other)[:, 2].max()) for other in earlier)
    return max(0.0, top - float(points[:, 2].min()))
