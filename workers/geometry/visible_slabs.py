"""The part of a loft's outline that is visible from its axis, cut into convex bodies stacked along the axis."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from schemas.base import Array
from workers.geometry.jit import compiled

INNER_SCALE = 0.5
"""Scale of the ring that makes a thin body thicker, relative to the body's widest ring."""

GRID_SHARE = 1e-4
"""Grid on which outlines are compared, as a share of the tolerance."""


@dataclass(frozen=True)
class Ring:
    """A ring about the axis: the copy of the outline's point at `share` of the side after `corner`.

    radius and height of the outline there, metres; the copy is scaled about the axis by `scale` and higher by `raised`.
    """

    corner: int
    share: float
    radius: float
    height: float
    scale: float = 1.0
    raised: float = 0.0


def trace_visible_border(outline: Array) -> list[Ring]:
    """The border, upwards, of what is visible from the axis between an outline's [N, 2] first and last point.

    Two rings for each slab between neighbouring heights of corners: its bottom and its top.
    """
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
            border.append(Ring(int(sides[near]), float(share[near]), float(radius[near]), float(height)))
    return border


def stack_slabs(
    border: Sequence[Ring], profiles: Array, visible: shapely.Polygon, tolerance: float, thin: float
) -> list[list[Ring]]:
    """The rings of each convex body, the lowest body first; bodies thinner than `thin` reach into their neighbours."""
    stacks: list[list[Ring]] = []
    for slab in zip(border[::2], border[1::2], strict=True):
        if stacks and all(_is_convex([*stacks[-1], *slab], outline, tolerance) for outline in profiles):
            stacks[-1] += slab
        else:
            stacks.append(list(slab))
    return [_thicken(stack, visible, tolerance, thin) for stack in stacks]


def _is_convex(rings: Sequence[Ring], outline: Array, tolerance: float) -> bool:
    """Whether no ring lies deeper than the tolerance below the hull of the body of revolution through all."""
    at = [outline[ring.corner, 0] * (1.0 - ring.share) + outline[ring.corner + 1, 0] * ring.share for ring in rings]
    line = [(float(radius) * ring.scale, ring.height) for radius, ring in zip(at, rings, strict=True)]
    return _deepest(np.array(line)) <= tolerance


@compiled
def _deepest(line: Array) -> float:
    """The most by which points [N, 2], radius and height, ascending, lie below the hull of them and their mirror images."""
    hull, count = np.empty_like(line), 0
    for n in range(len(line)):
        # Andrew's monotone chain (1979), of the side away from the axis
        while count > 1 and _left_of(line[n], hull[count - 2], hull[count - 1]) <= 0.0:
            count -= 1
        hull[count, 0], hull[count, 1] = line[n, 0], line[n, 1]
        count += 1
    deepest = 0.0
    for n in range(len(line)):
        # The ends of the hull are level
        depth = min(line[n, 1] - line[0, 1], line[-1, 1] - line[n, 1])
        for k in range(count - 1):
            depth = min(depth, _left_of(line[n], hull[k], hull[k + 1]))
        deepest = max(deepest, depth)
    return deepest


@compiled
def _left_of(point: Array, start: Array, stop: Array) -> float:
    """Distance of a point [2] to the left of the line from start to stop, 0 where these are the same."""
    x, y = stop[0] - start[0], stop[1] - start[1]
    length = math.sqrt(x * x + y * y)
    return (x * (point[1] - start[1]) - y * (point[0] - start[0])) / length if length > 0.0 else 0.0


def _thicken(rings: list[Ring], visible: shapely.Polygon, tolerance: float, thin: float) -> list[Ring]:
    """The rings of a body, and where it is thin a narrower one below and above as far as that is visible too."""
    if rings[-1].height - rings[0].height >= thin:
        return rings
    widest = max(rings, key=lambda ring: ring.radius)
    for end, step in ((rings[0], -thin), (rings[-1], thin)):
        height = end.height + step
        raised = height - widest.height
        inner = dataclasses.replace(
            widest, radius=INNER_SCALE * widest.radius, height=height, scale=INNER_SCALE, raised=raised
        )
        body = shapely.MultiPoint([(0.0, end.height), *((ring.radius, ring.height) for ring in (*rings, inner))])
        if visible.buffer(0.1 * tolerance).covers(body.convex_hull):
            rings = [*rings, inner]
    return rings


def is_covered(cell: Array, visible: shapely.Polygon, tolerance: float) -> bool:
    """Whether a cell [M, 2] lies in the visible polygon, except for slivers narrower than the tolerance."""
    # On a grid: sides that coincide except for rounding have no valid difference in plain doubles.
    whole, seen = shapely.make_valid([shapely.Polygon(cell), visible])
    left = shapely.difference(whole, seen, grid_size=GRID_SHARE * tolerance)
    return bool(left.buffer(-0.5 * tolerance).is_empty)


def ring_points(columns: Array, outline: Array, rings: Sequence[Ring]) -> Array:
    """[N, 3] float64: the points of rings of the loft whose columns [P, n, 3] follow the outline [P, 2]."""
    (low, start), (high, stop) = ((float(outline[k, 1]), columns[k, 0]) for k in (0, -1))

    def axis(height: float) -> Array:
        share = (height - low) / (high - low)
        return start * (1.0 - share) + stop * share

    clouds = []
    for ring in rings:
        points = columns[ring.corner] * (1.0 - ring.share) + columns[ring.corner + 1] * ring.share
        if ring.scale != 1.0:
            points = axis(ring.height) + ring.scale * (points - axis(ring.height - ring.raised))
        clouds.append(points)
    return np.concatenate(clouds)
