"""Decomposition of lofts, of which all built-in shapes are made, into convex parts.

The section of a loft along one column of its rings is an outline that ends at the axis. The part of it that is visible from
the axis, level with the rings, is cut into stacked bodies, each the hull of whole rings. The rest is cut into plane cells,
and each cell, between two neighbouring columns, is a wedge: exact where columns lie in planes through the axis, because its
facets are flat then. docs/measured.md says how many parts there are, and how near they are to the surface.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
import shapely

from schemas.base import Array, frozen_array
from schemas.scene.shape import Loft
from workers.geometry.hull import convex_hull, least_width_m
from workers.geometry.jit import compiled, compiled_for
from workers.geometry.mesh import hold_to_one_thread, mesh_of, unique_rows
from workers.geometry.outlines import Indices, partition_outlines

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


@compiled_for("f8[:,::1]")
def _deepest(line: Array) -> float:
    """The most by which points [N, 2], radius and height, ascending, lie below the hull of them and their mirror images."""
    hull, count = np.empty_like(line), 0
    for n in range(len(line)):
        # Andrew's monotone chain (1979), of the side away from the axis
        while count > 1 and _distance_left_of(line[n], hull[count - 2], hull[count - 1]) <= 0.0:
            count -= 1
        hull[count, 0], hull[count, 1] = line[n, 0], line[n, 1]
        count += 1
    deepest = 0.0
    for n in range(len(line)):
        # The ends of the hull are level
        depth = min(line[n, 1] - line[0, 1], line[-1, 1] - line[n, 1])
        for k in range(count - 1):
            depth = min(depth, _distance_left_of(line[n], hull[k], hull[k + 1]))
        deepest = max(deepest, depth)
    return deepest


@compiled
def _distance_left_of(point: Array, start: Array, stop: Array) -> float:
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


TOLERANCE = 1.6e-4
"""Share of the size of all lofts by which parts may reach out of one where that saves parts: 40 micrometres of 0.25 m."""

COARSE = 8e-3
"""The same for many objects at once, 1 mm of an eighth of a metre: a third as many parts. With 1.5 mm three of eight piles
do not come to balance, because rims of jars and mugs go into one another."""

WEDGE = 4.0
"""Tolerances by which points of a coarse wedge may lie outside the planes of its facets. It reaches out of the surface by a
quarter of that: at 2.5 a pile of eight takes a half longer."""

TWIST = 4.0
"""Tolerances by which a twisted facet may stand out: what it is cut into is four times as many parts."""

THIN = 1.6e-3
"""Cells narrower than this share of the size, 0.4 mm of 0.25 m, are widened into their neighbours: Bullet lets thin shapes
sink in, and a needle of half this width falls through a table."""


def decompose_lofts(lofts: Sequence[Loft], share: float = TOLERANCE) -> tuple[Array, ...]:
    """Vertices [N, 3] of convex parts, which may overlap and whose union is that of the lofts.

    They reach out of the lofts by at most this share of the size of all. Raises ValueError for an outline that crosses itself.
    """
    hold_to_one_thread()
    rings = np.concatenate([loft.rings.reshape(-1, 3) for loft in lofts])
    size = float(np.linalg.norm(np.ptp(rings, axis=0)))
    return tuple(frozen_array(part) for loft in lofts for part in _decompose(loft, size, share * size))


def _decompose(loft: Loft, size: float, tolerance: float) -> list[Array]:
    ends = np.broadcast_to(loft.ends[:, None, None], (2, 1, loft.rings.shape[1], 3))
    columns = np.concatenate([ends[0], loft.rings, ends[1]])  # [L + 2, n, 3]
    profiles = loft.profiles
    parts = _join_rings(loft.rings) if profiles is None else _decompose_lathed(profiles, columns, size, tolerance)
    for cutter in loft.cutters:
        for body in _decompose(cutter, size, tolerance):
            parts = [left for part in parts for left in _subtract(part, body, 0.9 * THIN * size)]
    return parts


def _join_rings(rings: Array) -> list[Array]:
    """Parts of a loft whose rings may lie askew: from ring to ring, or over several where that is as convex."""
    parts, volume = [rings[:2]], _hull_volume(rings[:2])
    for number in range(2, len(rings)):
        link, longer = rings[number - 1 : number + 1], np.concatenate([parts[-1], rings[number : number + 1]])
        separate, joined = _hull_volume(link), _hull_volume(longer)
        if joined <= (volume + separate) * (1.0 + 1e-9):
            parts[-1], volume = longer, joined
        else:
            parts.append(link)
            volume = separate
    return [part.reshape(-1, 3) for part in parts]


def _hull_of(points: Array) -> manifold3d.Manifold:
    return manifold3d.Manifold.hull_points(np.ascontiguousarray(points.reshape(-1, 3)))


def _hull_volume(points: Array) -> float:
    return float(_hull_of(points).volume())


def _decompose_lathed(profiles: Array, columns: Array, size: float, tolerance: float) -> list[Array]:
    """Parts of a loft with an axis: stacked bodies about it, and wedges."""
    outline = profiles[0]
    border = trace_visible_border(outline)
    visible = shapely.Polygon([outline[0], *((ring.radius, ring.height) for ring in border), outline[-1]])
    stacks = stack_slabs(border, profiles, visible, tolerance, THIN * size)
    parts = [unique_rows(ring_points(columns, outline, stack)) for stack in stacks]
    if is_covered(outline, visible, tolerance):
        return parts
    for cell in partition_outlines(profiles, tolerance):
        if not is_covered(outline[cell], visible, tolerance):
            wider = _widen(cell, outline, tolerance, THIN * size)
            # Facets of a solid of revolution are flat: only of others the bands that a cell borders on may be twisted
            bands = wider[np.roll(wider, -1) == wider + 1] if len(profiles) > 1 else wider[:0]
            parts += _cut_wedges(columns, wider, bands, tolerance, WEDGE if tolerance >= COARSE * size else 1.0)
    return parts


def _cut_wedges(columns: Array, cell: Indices, bands: Indices, tolerance: float, times: float) -> list[Array]:
    """Parts of a cell between neighbouring columns [P, n, 3], or over several where that is as convex.

    bands [M]: the sides of the outline that the cell borders on, by their first corner; times: tolerances by which a part
    over several may stand out.
    """
    count = columns.shape[1]
    begin, end = columns[cell], columns[np.roll(cell, -1)]
    parts, first = [], 0
    while first < count:
        last = first + 1
        while last < count and _protrusion(begin, end, first, last + 1) <= times * tolerance:
            last += 1
        over = np.arange(first, last + 1) % count
        wedge = unique_rows(begin[:, over].reshape(-1, 3))
        parts += _split_twisted(wedge, columns[bands][:, over], columns[bands + 1][:, over], TWIST * tolerance)
        first = last
    return parts


@compiled_for("f8[:,:,::1], f8[:,:,::1], i8, i8")
def _protrusion(begin: Array, end: Array, first: int, last: int) -> float:
    """Distance by which a cell lies outside the planes of its facets; begin, end [M, k, 3]: of its sides, along k columns.

    The cell is that from the column `first` to `last`, counted on beyond the end.
    """
    most, count = 0.0, begin.shape[1]
    for side in range(begin.shape[0]):
        for column in range(first, last):
            a, b = begin[side, column % count], begin[side, (column + 1) % count]
            c, d = end[side, column % count], end[side, (column + 1) % count]
            p, q = b - c, d - a
            x, y, z = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
            length = math.sqrt(x * x + y * y + z * z)
            if length == 0.0:
                continue
            reach = -np.inf
            for corner in (a, b, c, d):
                reach = max(reach, x * corner[0] + y * corner[1] + z * corner[2])
            for other in range(begin.shape[0]):
                for number in range(first, last + 1):
                    point = begin[other, number % count]
                    most = max(most, (x * point[0] + y * point[1] + z * point[2] - reach) / length)
    return most


def _split_twisted(wedge: Array, begin: Array, end: Array, tolerance: float) -> list[Array]:
    """The wedge; where the diagonal of a twisted facet is a valley, the parts of it below either triangle of the facet.

    begin, end [F, k, 3]: of the outline's sides that facets are on. A facet's diagonal is the one of `loft`.
    """
    parts = [wedge]
    if not begin.size:
        return parts
    a, b, c, d = (each.reshape(-1, 3) for each in (begin[:, :-1], begin[:, 1:], end[:, 1:], end[:, :-1]))
    normals = np.stack([np.cross(b - a, c - a), np.cross(c - a, d - a)], axis=1)  # [F, 2, 3]
    lengths = np.linalg.norm(normals, axis=2)
    valley = ((d - a) * normals[:, 0]).sum(axis=1) > tolerance * lengths[:, 0]
    for facet in np.flatnonzero(valley & (lengths.min(axis=1) > 0.0)):
        planes = zip(normals[facet] / lengths[facet, :, None], (b[facet], d[facet]), strict=True)
        parts = [
            mesh_of(rest).vertices
            for part, (normal, at) in itertools.product(parts, tuple(planes))
            if not (rest := _hull_of(part).trim_by_plane((-normal).tolist(), -float(normal @ at))).is_empty()
        ]
    return parts


def _widen(cell: Indices, outline: Array, tolerance: float, thin: float) -> Indices:
    """The cell; where it is thin, with the further corner that widens its hull most inside the outline [N, 2]."""
    widest, best = _least_width(outline[cell]), -1
    if widest >= thin:
        return cell
    body = shapely.Polygon(outline).buffer(0.1 * tolerance)
    for corner in range(len(outline)):
        hull = shapely.MultiPoint(outline[[*cell, corner]]).convex_hull
        if body.covers(hull):
            widest, best = max((widest, best), (_least_width(np.array(hull.exterior.coords)[:-1]), corner))
    if best < 0:
        return cell
    wider = np.append(cell, best)
    away = outline[wider] - outline[wider].mean(axis=0)
    return wider[np.argsort(np.arctan2(away[:, 1], away[:, 0]), kind="stable")]


def _least_width(corners: Array) -> float:
    """Least width of a convex outline [M, 2]: from a side to the farthest corner, where that is least."""
    along = np.roll(corners, -1, axis=0) - corners
    length = np.sqrt((along * along).sum(axis=1))
    along = along[length > 0.0] / length[length > 0.0, None]
    away = corners[None] - corners[length > 0.0][:, None]
    return float(np.abs(along[:, None, 0] * away[..., 1] - along[:, None, 1] * away[..., 0]).max(axis=1).min())


def _subtract(part: Array, body: Array, thin: float) -> list[Array]:
    """Convex parts of a convex part minus a convex body: what lies beyond each of the body's faces, the most first.

    What lies beyond two faces is given to the first alone, unless the second's would be thinner than `thin`, metres.
    """
    solid, cutter = _hull_of(part), _hull_of(body)
    if (solid ^ cutter).is_empty():
        return [part]
    hull = convex_hull(body)
    normals = np.unique(np.round(hull.normals, 9), axis=0)
    reach = (hull.vertices @ normals.T).max(axis=0)
    beyond = [solid.trim_by_plane(n.tolist(), float(far)) for n, far in zip(normals, reach, strict=True)]
    order = sorted(range(len(normals)), key=lambda k: -beyond[k].volume())
    left: list[Array] = []
    taken: list[int] = []
    for k in order:
        if beyond[k].is_empty():
            break
        rest = new = beyond[k]
        for earlier in taken:
            inner = (-normals[earlier]).tolist(), -float(reach[earlier])
            new, less = new.trim_by_plane(*inner), rest.trim_by_plane(*inner)
            if new.is_empty():
                break
            if not less.is_empty() and least_width_m(convex_hull(mesh_of(less).vertices)) >= thin:
                rest = less
        if new.is_empty():
            continue
        taken.append(k)
        left.append(mesh_of(rest).vertices)
    return left
