"""A plane outline cut into convex cells. Pure.

Every corner that turns inwards is cut off by the shortest way that leaves no such corner behind: to another corner, to
the nearest point of a side, or straight on from one of its own sides. Of n such corners come at most n + 1 cells.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

TWICE = 0.6
"""A cut that ends at another corner which turns inwards, and mends it too, counts as so much of its length."""

ALMOST = 1e-9
"""Share of the outline's size by which a cut may touch what it does not cross."""

CORNER = 1e-6
"""A cut that ends nearer to a corner than this share of the side ends at the corner."""


class Between(NamedTuple):
    """A point at `share` of the way from point `a` to point `b`."""

    a: int
    b: int
    share: float


@dataclass(frozen=True, eq=False)
class Cells:
    """Convex cells as point numbers [M], counter-clockwise: first the outline's N corners, then the `added` ones."""

    added: tuple[Between, ...]
    cells: tuple[Indices, ...]

    def points(self, corners: Array) -> Array:
        """[N + added, ...] float64: every point, of this outline [N, ...] or of another that was cut alike."""
        points = [corners]
        for a, b, share in self.added:
            ends = [corners[k] if k < len(corners) else points[1 + k - len(corners)][0] for k in (a, b)]
            points.append((ends[0] * (1.0 - share) + ends[1] * share)[None])
        return np.concatenate(points)

    def sides_of(self, cell: Indices, corners: int) -> Indices:
        """[M] int64: on which side of the outline, of so many corners, a cell's sides lie; -1: a cut, or the last side."""
        on = [{k - 1, k} for k in range(corners)]
        for a, b, _ in self.added:
            on.append({min(a, b)} if max(a, b) < corners and abs(a - b) == 1 else on[a] & on[b])
        found = [on[a] & on[b] - {-1, corners - 1} for a, b in zip(cell, np.roll(cell, -1), strict=True)]
        return np.array([min(sides, default=-1) for sides in found])


class _Cut(NamedTuple):
    """A cut from a corner to the point at `share` of the side after corner `side`, and what it counts."""

    counts: float
    corner: int
    side: int
    share: float


def convex_cells(outlines: Array, tolerance: float) -> Cells:
    """Cells of simple outlines [K, N, 2] that are cut alike, counter-clockwise, no two corners of one at one place.

    They turn inwards nowhere by more than `tolerance`, in the outlines' unit: by so much their hulls may reach out of them.
    """
    points, added = np.moveaxis(outlines, 0, 1), []  # [points, K, 2]
    cells, left = [], [np.arange(outlines.shape[1])]
    while left:
        cell = left.pop()
        cut = _next_cut(np.moveaxis(points[cell], 1, 0), tolerance)
        if cut is None:
            cells.append(cell)
            continue
        before, after = cut.side, (cut.side + 1) % len(cell)
        if cut.share > 0.0:
            added.append(Between(int(cell[before]), int(cell[after]), cut.share))
            points = np.concatenate(
                [points, [points[cell[before]] * (1 - cut.share) + points[cell[after]] * cut.share]]
            )
            end = len(points) - 1
        else:
            end, before = int(cell[before]), (before - 1) % len(cell)
        left.append(np.array([*_walk(cell, cut.corner, before), end]))
        left.append(np.array([end, *_walk(cell, after, cut.corner)]))
    return Cells(tuple(added), tuple(cells))


def cross(a: Array, b: Array) -> Array:
    """[...] float64: of plane vectors [..., 2], positive where b lies to the left of a."""
    found: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return found


def _walk(cell: Indices, first: int, last: int) -> list[int]:
    """The corners from one to another, both included."""
    return [int(cell[(first + k) % len(cell)]) for k in range((last - first) % len(cell) + 1)]


def _next_cut(outlines: Array, tolerance: float) -> _Cut | None:
    """Where outlines [K, M, 2] are cut next, None where they are convex."""
    deep = sorted({corner for outline in outlines for corner in _deep(outline, tolerance)})
    if not deep:
        return None
    inwards = np.zeros(outlines.shape[1], dtype=np.bool_)
    inwards[deep] = True
    found = [cut for corner in deep if (cut := _shortest(outlines, corner, inwards)) is not None]
    if not found:
        raise ValueError("an outline that crosses itself, or outlines too unlike one another")
    return min(found)


def _deep(outline: Array, tolerance: float) -> list[int]:
    """The corners to cut: those that turn inwards by more than the tolerance; or else the deepest of each bay of the hull."""
    deep = np.flatnonzero(_left_of(outline, np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0)) > tolerance)
    if len(deep):
        return [int(k) for k in deep]
    found, on_hull = [], _on_hull(outline)
    for start, stop in zip(on_hull, [*on_hull[1:], on_hull[0] + len(outline)], strict=True):
        bay = np.arange(start + 1, stop) % len(outline)
        if len(bay):
            below = _left_of(outline[bay], outline[start], outline[stop % len(outline)])
            if below.max() > tolerance:
                found.append(int(bay[int(below.argmax())]))
    return found


def _left_of(points: Array, start: Array, stop: Array) -> Array:
    """[...] float64: how far points lie to the left of the lines from start to stop."""
    along = stop - start
    length = np.sqrt((along * along).sum(axis=-1))
    return cross(along, points - start) / np.where(length == 0.0, 1.0, length)


def _on_hull(outline: Array) -> list[int]:
    """The corners on the hull of a simple outline, in their order (Andrew's monotone chain)."""
    order = np.lexsort((outline[:, 1], outline[:, 0])).tolist()
    at = outline.tolist()
    kept: set[int] = set()
    for way in (order, order[::-1]):
        chain: list[int] = []
        for k in way:
            while len(chain) > 1 and _turn(at[chain[-2]], at[chain[-1]], at[k]) <= 0.0:
                chain.pop()
            chain.append(k)
        kept.update(chain)
    return sorted(kept)


def _turn(a: list[float], b: list[float], c: list[float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _shortest(outlines: Array, corner: int, inwards: Mask) -> _Cut | None:
    """The best cut from a corner that turns inwards in one of the outlines."""
    sides, shares = _candidates(outlines, corner)
    along = np.roll(outlines, -1, axis=1) - outlines
    ways = outlines[:, sides] + along[:, sides] * shares[:, None] - outlines[:, corner, None]  # [K, cuts, 2]
    before, after = outlines[:, corner] - outlines[:, corner - 1], along[:, corner]
    length = np.sqrt((ways * ways).sum(axis=2))
    slack = -ALMOST * length * np.sqrt((before * before).sum(axis=1) + (after * after).sum(axis=1))[:, None]
    mends = ((cross(before[:, None], ways) >= slack) & (cross(after[:, None], ways) >= slack)).all(axis=0)
    counts = length[0] * np.where((shares == 0.0) & inwards[sides], TWICE, 1.0)
    for k in np.argsort(counts, kind="stable"):
        if mends[k] and all(
            _sees(one, corner, int(sides[k]), float(shares[k]), way[k]) for one, way in zip(outlines, ways, strict=True)
        ):
            return _Cut(float(counts[k]), corner, int(sides[k]), float(shares[k]))
    return None


def _candidates(outlines: Array, corner: int) -> tuple[Indices, Array]:
    """Sides and shares of them: all other corners, the nearest point of each side, and straight on from its own sides."""
    count = outlines.shape[1]
    numbers = np.arange(count)
    sides, shares = [numbers], [np.zeros(count)]
    for outline in outlines:
        here, along = outline[corner], np.roll(outline, -1, axis=0) - outline
        nearest = ((here - outline) * along).sum(axis=1) / (along * along).sum(axis=1)
        straight = [_hits(here, way, outline, along) for way in (here - outline[corner - 1], -along[corner])]
        sides += [numbers] * 3
        shares += [nearest, *straight]
    side, share = np.concatenate(sides), np.concatenate(shares)
    inner = (share > CORNER) & (share < 1.0 - CORNER) & ((side + 1) % count != corner)  # false for nan
    ends = (share == 0.0) & (side != (corner + 1) % count) & (side != (corner - 1) % count)
    kept = (inner | ends) & (side != corner)
    return side[kept], share[kept]


def _hits(here: Array, way: Array, start: Array, along: Array) -> Array:
    """[M] float64: at which share of each side a ray meets it; nan where it does not."""
    across = cross(way, along)
    apart = np.where(across == 0.0, 1.0, across)
    share, far = -cross(way, start - here) / apart, cross(start - here, along) / apart
    return np.where((across != 0.0) & (far > 0.0) & (share >= 0.0) & (share <= 1.0), share, np.nan)


def _sees(outline: Array, corner: int, side: int, share: float, way: Array) -> bool:
    """Whether a cut meets no side but those that it begins and ends at."""
    count = len(outline)
    others = np.ones(count, dtype=np.bool_)
    others[[corner, corner - 1, side]] = False
    if share == 0.0:
        others[side - 1] = False
    here, start, stop = outline[corner], outline[others], np.roll(outline, -1, axis=0)[others]
    slack = ALMOST * float(np.square(outline - here).max())
    left, right = cross(way, start - here), cross(way, stop - here)
    first, second = cross(stop - start, here - start), cross(stop - start, here + way - start)
    apart = (np.minimum(left, right) > slack) | (np.maximum(left, right) < -slack)
    apart |= (np.minimum(first, second) > slack) | (np.maximum(first, second) < -slack)
    return bool(apart.all())
