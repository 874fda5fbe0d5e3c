"""What of a loft's outline is seen from its axis, cut into convex bodies that are stacked along it. Pure."""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from schemas.base import Array

INNER = 0.5
"""What is added to a thin body is so much narrower than it."""


GRID_SHARE = 1e-4
"""Of the tolerance: the grid on which outlines are compared."""


@dataclass(frozen=True)
class Level:
    """A ring of a body about the axis: a copy of the outline's point at `share` of the side after `corner`.

    radius and height, metres, of the outline there; `scale` and `raised`: the copy is so much narrower, and higher.
    """

    corner: int
    share: float
    radius: float
    height: float
    scale: float = 1.0
    raised: float = 0.0


def seen_from_axis(outline: Array) -> list[Level]:
    """The border of what is seen from the axis between the outline's [N, 2] first and last point, with these, upwards."""
    low, high = outline[:-1], outline[1:]
    heights = np.unique(outline[:, 1])
    heights = heights[(heights >= outline[0, 1]) & (heights <= outline[-1, 1])]
    border = []
    for bottom, top in itertools.pairwise(heights):
        spans = np.minimum(low[:, 1], high[:, 1]) <= bottom
        sides = np.flatnonzero(spans & (np.maximum(low[:, 1], high[:, 1]) >= top))
        a, b = low[sides], high[sides]
        shares = [(height - a[:, 1]) / (b[:, 1] - a[:, 1]) for height in (bottom, top)]
        radii = [a[:, 0] * (1.0 - share) + b[:, 0] * share for share in shares]
        near = int((radii[0] + radii[1]).argmin())
        for share, radius, height in zip(shares, radii, (bottom, top), strict=True):
            border.append(Level(int(sides[near]), float(share[near]), float(radius[near]), float(height)))
    return border


def stacks_of(
    border: Sequence[Level], profiles: Array, seen: shapely.Polygon, tolerance: float, thin: float
) -> list[list[Level]]:
    """The levels of each convex body, the lowest body first; thin ones reach into their neighbours."""
    stacks: list[list[Level]] = []
    for slab in zip(border[::2], border[1::2], strict=True):
        if stacks and all(_is_convex([*stacks[-1], *slab], outline, tolerance) for outline in profiles):
            stacks[-1] += slab
        else:
            stacks.append(list(slab))
    return [_thickened(stack, seen, tolerance, thin) for stack in stacks]


def _is_convex(levels: Sequence[Level], outline: Array, tolerance: float) -> bool:
    """Whether the body of revolution through the levels reaches out of none of them by more than this."""
    line = [(_radius(level, outline), level.height) for level in levels]
    border = shapely.MultiPoint([*line, *((-r, z) for r, z in line)]).convex_hull.exterior
    return bool(shapely.distance(border, shapely.points(line)).max() <= tolerance)


def _radius(level: Level, outline: Array) -> float:
    a, b = outline[level.corner, 0], outline[level.corner + 1, 0]
    return float(a * (1.0 - level.share) + b * level.share) * level.scale


def _thickened(levels: list[Level], seen: shapely.Polygon, tolerance: float, thin: float) -> list[Level]:
    if levels[-1].height - levels[0].height >= thin:
        return levels
    widest = max(levels, key=lambda level: level.radius)
    for end, way in ((levels[0], -thin), (levels[-1], thin)):
        height = end.height + way
        inner = dataclasses.replace(
            widest, radius=INNER * widest.radius, height=height, scale=INNER, raised=height - widest.height
        )
        body = shapely.MultiPoint([(0.0, end.height), *((level.radius, level.height) for level in (*levels, inner))])
        if seen.buffer(0.1 * tolerance).covers(body.convex_hull):
            levels = [*levels, inner]
    return levels


def is_covered(cell: Array, seen: shapely.Polygon, tolerance: float) -> bool:
    """Whether a cell [M, 2] lies in what is seen, but for slivers narrower than the tolerance."""
    # On a grid: sides that lie on one another but for the last bits have no difference in plain doubles.
    whole, visible = shapely.make_valid([shapely.Polygon(cell), seen])
    left = shapely.difference(whole, visible, grid_size=GRID_SHARE * tolerance)
    return bool(left.buffer(-0.5 * tolerance).is_empty)


def rings_at(lines: Array, outline: Array, levels: Sequence[Level]) -> Array:
    """[N, 3] float64: the points of the levels' rings, of the loft whose columns are lines [P, n, 3]."""
    (low, start), (high, stop) = ((float(outline[k, 1]), lines[k, 0]) for k in (0, -1))

    def axis(height: float) -> Array:
        share = (height - low) / (high - low)
        return start * (1.0 - share) + stop * share

    rings = []
    for level in levels:
        ring = lines[level.corner] * (1.0 - level.share) + lines[level.corner + 1] * level.share
        if level.scale != 1.0:
            ring = axis(level.height) + level.scale * (ring - axis(level.height - level.raised))
        rings.append(ring)
    return np.concatenate(rings)
