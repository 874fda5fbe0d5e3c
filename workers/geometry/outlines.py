"""Outlines in a plane, cut into cells that are convex to a tolerance. Pure.

An outline is cut into cells along its diagonals: the shortest at reflex corners first, and those that later cuts made needless
are taken out again (Hertel and Mehlhorn 1983). A constrained Delaunay triangulation (shapely) gives as many cells when its
triangles are merged, but outlines that differ are not cut alike: of built-in bottles with two outlines, every third has a
triangle of one that is turned over in the other.
"""

import numpy as np
import shapely
from numpy.typing import NDArray

from schemas.base import Array

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

SHORTENED = 1e-6
"""Share of a diagonal left out at each end when it is tested for lying inside the outline."""


def partition_outlines(outlines: Array, tolerance: float) -> tuple[Indices, ...]:
    """Cells of simple outlines [K, N, 2], the same for all: ascending numbers [M] of their corners, counter-clockwise.

    The outlines run counter-clockwise, no two corners of one at one place. The hull of a cell reaches out of it by at
    most `tolerance`, in the outlines' unit. Raises ValueError for an outline that crosses itself, and for outlines so
    unlike one another that no diagonal lies inside all of them.
    """
    diagonals = _inner_diagonals(outlines)
    cells, cuts, left = [], [], [np.arange(outlines.shape[1])]
    while left:
        cell = left.pop()
        deep = cell[_deep_corners(outlines, cell, tolerance)]
        if not len(deep):
            cells.append(cell)
            continue
        a, b = np.searchsorted(cell, diagonals.T)
        inside = np.isin(diagonals, cell).all(axis=1) & (b - a > 1) & (b - a < len(cell) - 1)
        useful = np.flatnonzero(inside & np.isin(diagonals, deep).any(axis=1))
        if not len(useful):
            raise ValueError("an outline that crosses itself, or outlines too unlike one another")
        shortest = useful[0]
        cuts.append(shortest)
        left += [cell[a[shortest] : b[shortest] + 1], np.delete(cell, slice(a[shortest] + 1, b[shortest]))]
    for cut in sorted(cuts, reverse=True):
        one, other = (k for k, cell in enumerate(cells) if np.isin(diagonals[cut], cell).all())
        merged = np.union1d(cells[one], cells[other])
        if not _deep_corners(outlines, merged, tolerance).any():
            cells[one] = merged
            del cells[other]
    return tuple(cells)


def _inner_diagonals(outlines: Array) -> Indices:
    """[D, 2]: pairs of corners whose line lies strictly inside all outlines, the nearest in the first outline first."""
    first, last = np.triu_indices(outlines.shape[1], 2)
    inside = np.ones(len(first), dtype=np.bool_)
    for outline in outlines:
        a, b = outline[first], outline[last]
        lines = shapely.linestrings(np.stack([a + SHORTENED * (b - a), b + SHORTENED * (a - b)], axis=1))
        polygon = shapely.Polygon(outline)
        shapely.prepare(polygon)
        inside &= shapely.contains_properly(polygon, lines)
    pairs = np.stack([first, last], axis=1)[inside]
    along = outlines[0, pairs[:, 1]] - outlines[0, pairs[:, 0]]
    return pairs[np.argsort((along * along).sum(axis=1), kind="stable")]


def _deep_corners(outlines: Array, cell: Indices, tolerance: float) -> Mask:
    """[M] bool: the corners of a cell that are reflex by more than the tolerance in any outline."""
    return np.logical_or.reduce([_deep(outline[cell], tolerance) for outline in outlines])


def _deep(outline: Array, tolerance: float) -> Mask:
    """[M] bool: reflex corners deeper than the tolerance; where there are none, the deepest corner of each such bay."""
    deep: Mask = left_of(outline, np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0)) > tolerance
    if deep.any():
        return deep
    hull = shapely.get_coordinates(shapely.convex_hull(shapely.multipoints(outline)))
    on_hull = np.flatnonzero(np.isin(outline @ [1, 1j], hull @ [1, 1j]))
    for start, stop in zip(on_hull, [*on_hull[1:], on_hull[0] + len(outline)], strict=True):
        bay = np.arange(start, stop) % len(outline)
        depth = left_of(outline[bay], outline[start], outline[stop % len(outline)])
        deep[bay[depth.argmax()]] = depth.max() > tolerance
    return deep


def left_of(points: Array, start: Array, stop: Array) -> Array:
    """[M] float64: distance of points [M, 2] to the left of the lines from start to stop."""
    along, away = stop - start, points - start
    length = np.sqrt((along * along).sum(axis=-1))
    turn = along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0]
    return turn / np.where(length == 0.0, 1.0, length)
