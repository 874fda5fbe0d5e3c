"""Pure: which axis of a shape points up, as far as its geometry tells, by the way that it stands."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from schemas.base import Array
from schemas.job.assets import UpAxis

FLAT_SHARE, ROUGH_SHARE = 0.004, 0.016
"""Shares of the diagonal within which points count as touching the ground: of smooth bottoms, and of scanned ones, which
are rumpled. A round side touches in a strip that is twice as wide in the second as in the first; a rumpled one in all."""

STANDS, ROLLS = (0.35, 0.65), (0.28, 0.58)
"""A shape stands where the centre of mass lies at least this share of the shape's half width inside its foot, for one of the
two; it rolls where both shares are smaller. What lies between is not decided."""

TIPS_DEG = 3.0
"""A shape that needs less of a lean to tip over does not stand."""

LIKELY_DEG = 10.0
"""A shape is likely to be upright where it stands by this much firmer than upside down, and so on no other axis."""

Verdict = Literal["stands", "rolls", "undecided"]
Confidence = Literal["sure", "likely"]

AXES: tuple[UpAxis, ...] = ("x", "y", "z")
DIRECTIONS = (*AXES, "-x", "-y", "-z")


@dataclass(frozen=True)
class Upright:
    """An axis that points up, and how far that is to be believed."""

    axis: UpAxis
    confidence: Confidence


@dataclass(frozen=True)
class Stand:
    """How a shape stands with one direction up.

    smooth, rough: of its half width, how far the centre of mass lies inside its foot, which is what lies within `FLAT_SHARE`
    or `ROUGH_SHARE` of the ground; smooth_deg, rough_deg: the lean at which it tips over the edge of that foot.
    """

    smooth: float
    rough: float
    smooth_deg: float
    rough_deg: float

    @property
    def verdict(self) -> Verdict:
        """Whether the shape stands so."""
        if self.rough_deg < TIPS_DEG or (self.smooth < ROLLS[0] and self.rough < ROLLS[1]):
            return "rolls"
        return "stands" if self.smooth >= STANDS[0] or self.rough >= STANDS[1] else "undecided"


def find_upright(hull_vertices: Array, com: Array) -> Upright | None:
    """Which axis is up; None where nothing tells.

    hull_vertices [H, 3] of the convex hull and com [3], any units, in the frame whose axes are asked about. `sure`: with
    this axis up or down the shape stands, and on both sides of the two others it rolls or tips. `likely`: it stands on
    several, and with this one up by `LIKELY_DEG` firmer than upside down, which no other is. Of an axis, the positive side
    is meant.
    """
    stands = {name: measure_stand(hull_vertices, com, name) for name in DIRECTIONS}
    for axis in AXES:
        others = [stand.verdict for name, stand in stands.items() if axis not in name]
        if others == ["rolls"] * 4 and "stands" in (stands[axis].verdict, stands[f"-{axis}"].verdict):
            return Upright(axis, "sure")
    firmer = {a: stands[a].smooth_deg - stands[f"-{a}"].smooth_deg for a in AXES if stands[a].verdict != "rolls"}
    order = sorted(firmer, key=lambda axis: -firmer[axis])
    if not order or firmer[order[0]] - max((firmer[axis] for axis in order[1:]), default=0.0) < LIKELY_DEG:
        return None
    return Upright(order[0], "likely")


def measure_stand(hull_vertices: Array, com: Array, up: str) -> Stand:
    """How the shape stands with the direction `up` upwards."""
    axis, sign = "xyz".index(up[-1]), -1.0 if up.startswith("-") else 1.0
    height = sign * hull_vertices[:, axis]
    ground = float(height.min())
    diagonal = float(np.linalg.norm(hull_vertices.max(axis=0) - hull_vertices.min(axis=0)))
    flat = np.delete(hull_vertices, axis, axis=1)
    middle = np.delete(com, axis)
    half_width = _depth_inside(flat, middle)
    if half_width <= 0.0:
        return Stand(0.0, 0.0, 0.0, 0.0)
    inside = [
        max(_depth_inside(flat[height <= ground + share * diagonal], middle), 0.0)
        for share in (FLAT_SHARE, ROUGH_SHARE)
    ]
    leans = [math.degrees(math.atan2(depth, sign * float(com[axis]) - ground)) for depth in inside]
    return Stand(inside[0] / half_width, inside[1] / half_width, leans[0], leans[1])


def _depth_inside(points: Array, point: Array) -> float:
    """How far a point [2] lies inside the convex hull of points [N, 2]; 0 where that has no area, negative outside."""
    if len(points) < 3:
        return 0.0
    try:
        sides = ConvexHull(points).equations
    except (QhullError, ValueError):
        return 0.0
    return float(-(sides[:, :2] @ point + sides[:, 2]).max())
