"""Vertical distances: how high a mesh stands at a point, and how far one mesh hangs above another."""

import numpy as np

from schemas.base import Array
from schemas.shape import Mesh

EDGE_SLACK = 1e-12
"""Barycentric slack, so that a point on the edge of two triangles lies in at least one of them."""

SAME_HEIGHT_M = 1e-9
"""A vertex this near the highest crossing of its vertical line is the top of its mesh there."""

CHUNK = 4_000_000
"""Point-triangle pairs worked on at once: about 200 MB."""


def heights_at(points_xy: Array, mesh: Mesh, highest: bool = True) -> Array:
    """Height of the mesh above or below each point of the plane, [N] float64 metres; nan where there is none.

    points_xy [N, 2] metres. The highest crossing of the vertical line, or the lowest.
    Vertical triangles have no height of their own: their edges belong to their neighbours.
    """
    result = np.full(len(points_xy), np.nan)
    if len(points_xy) == 0:
        return result
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    lower = np.minimum(np.minimum(a, b), c)[:, :2]
    upper = np.maximum(np.maximum(a, b), c)[:, :2]
    near = (
        (np.abs(area) > 1e-18)
        & (lower <= points_xy.max(axis=0)).all(axis=1)
        & (upper >= points_xy.min(axis=0)).all(axis=1)
    )
    a, b, c, area = a[near], b[near], c[near], area[near]
    if len(a) == 0:
        return result
    size = max(1, CHUNK // len(a))
    for start in range(0, len(points_xy), size):
        z = _crossings(points_xy[start : start + size], a, b, c, area)
        hit = np.isfinite(z).any(axis=1)
        best = np.nanmax(z[hit], axis=1) if highest else np.nanmin(z[hit], axis=1)
        result[start : start + size][hit] = best
    return result


def _crossings(points: Array, a: Array, b: Array, c: Array, area: Array) -> Array:
    """[N, F] heights at which vertical lines cross triangles, nan where they miss."""
    x, y = points[:, :1], points[:, 1:]
    wb = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (y - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
    wc = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0])) / area
    inside = (wb >= -EDGE_SLACK) & (wc >= -EDGE_SLACK) & (wb + wc <= 1.0 + EDGE_SLACK)
    return np.where(inside, a[:, 2] + wb * (b[:, 2] - a[:, 2]) + wc * (c[:, 2] - a[:, 2]), np.nan)


def vertical_gap(upper: Mesh, lower: Mesh, band_m: float = 0.02) -> float:
    """Least vertical distance from `upper` down to `lower`, metres; negative where it reaches into it.

    Both in world coordinates, the first standing on top of the second. Vertices of each are held against faces of the
    other; that is exact unless the nearest features are two crossing edges. Of the upper mesh only vertices within
    `band_m` of its lowest point are tried. inf where nothing is above anything.
    """
    gaps = [np.inf]
    points = upper.vertices[upper.vertices[:, 2] <= upper.vertices[:, 2].min() + band_m]
    ground = heights_at(points[:, :2], lower)
    if np.isfinite(ground).any():
        gaps.append(float(np.nanmin(points[:, 2] - ground)))
    low, high = upper.vertices.min(axis=0)[:2], upper.vertices.max(axis=0)[:2]
    below = lower.vertices[((lower.vertices[:, :2] >= low) & (lower.vertices[:, :2] <= high)).all(axis=1)]
    if len(below):
        below = below[below[:, 2] >= heights_at(below[:, :2], lower) - SAME_HEIGHT_M]
        ceiling = heights_at(below[:, :2], upper, highest=False)
        if np.isfinite(ceiling).any():
            gaps.append(float(np.nanmin(ceiling - below[:, 2])))
    return min(gaps)
