"""Vertical distances: how high a mesh stands at a point, and how far one mesh hangs above another."""

from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Mesh

EDGE_SLACK = 1e-12
"""Barycentric slack, so that a point on the edge of two triangles lies in at least one of them."""

SAME_HEIGHT_M = 1e-9
"""A vertex this near the highest crossing of its vertical line is the top of its mesh there."""

FIRST_LOOK_M = 1e-4
"""Vertices this near the lowest one are held against the ground first: of an object that stands they settle the gap."""

CHUNK = 4_000_000
"""Point-triangle pairs worked on at once: about 200 MB."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """A mesh whose heights are asked for more than once, [F, ...] float64 for its F triangles that are not vertical.

    Their corners a, b, c; twice the area that each has in the plane; and the corners of the box about it.
    """

    vertices: Array
    corners: tuple[Array, Array, Array]
    area: Array
    low: Array
    high: Array


def survey(mesh: Mesh) -> Terrain:
    """A mesh made ready for `heights_at`.

    Vertical triangles have no height of their own: their edges belong to their neighbours.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    level = np.abs(area) > 1e-18
    a, b, c = a[level], b[level], c[level]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    return Terrain(mesh.vertices, (a, b, c), area[level], low, high)


def heights_at(points_xy: Array, ground: Mesh | Terrain, highest: bool = True) -> Array:
    """Height of the mesh above or below each point of the plane, [N] float64 metres; nan where there is none.

    points_xy [N, 2] metres. The highest crossing of the vertical line, or the lowest.
    """
    result = np.full(len(points_xy), np.nan)
    if len(points_xy) == 0:
        return result
    terrain = survey(ground) if isinstance(ground, Mesh) else ground
    (left, front), (right, back) = points_xy.min(axis=0), points_xy.max(axis=0)
    low, high = terrain.low, terrain.high
    near = np.flatnonzero((low[:, 0] <= right) & (low[:, 1] <= back) & (high[:, 0] >= left) & (high[:, 1] >= front))
    a, b, c = (corner[near] for corner in terrain.corners)
    area = terrain.area[near]
    if len(near) == 0:
        return result
    size = max(1, CHUNK // len(near))
    for start in range(0, len(points_xy), size):
        z = _crossings(points_xy[start : start + size], a, b, c, area)
        missed = np.isnan(z)
        outside = -np.inf if highest else np.inf
        z[missed] = outside
        best = z.max(axis=1) if highest else z.min(axis=1)
        best[best == outside] = np.nan
        result[start : start + size] = best
    return result


def _crossings(points: Array, a: Array, b: Array, c: Array, area: Array) -> Array:
    """[N, F] heights at which vertical lines cross triangles, nan where they miss."""
    x, y = points[:, :1], points[:, 1:]
    wb = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (y - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
    wc = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0])) / area
    inside = (wb >= -EDGE_SLACK) & (wc >= -EDGE_SLACK) & (wb + wc <= 1.0 + EDGE_SLACK)
    return np.where(inside, a[:, 2] + wb * (b[:, 2] - a[:, 2]) + wc * (c[:, 2] - a[:, 2]), np.nan)


def vertical_gap(upper: Mesh, lower: Mesh | Terrain, band_m: float = 0.02) -> float:
    """Least vertical distance from `upper` down to `lower`, metres; negative where it reaches into it.

    Both in world coordinates, the first standing on top of the second. Vertices of each are held against faces of the
    other; that is exact unless the nearest features are two crossing edges. Of the upper mesh only vertices within
    `band_m` of its lowest point are tried. inf where nothing is above anything.
    """
    terrain = survey(lower) if isinstance(lower, Mesh) else lower
    gap = _least_gap_below(upper.vertices, terrain, band_m)
    bottom, summit = upper.vertices.min(axis=0), upper.vertices.max(axis=0)
    # A vertex of the lower mesh has at least the distance to the lowest point of all above it.
    rises = bottom[2] - terrain.vertices[:, 2] < gap
    under = terrain.vertices[rises]
    under = under[((under[:, :2] >= bottom[:2]) & (under[:, :2] <= summit[:2])).all(axis=1)]
    if len(under):
        under = under[under[:, 2] >= heights_at(under[:, :2], terrain) - SAME_HEIGHT_M]
        ceiling = heights_at(under[:, :2], upper, highest=False)
        if np.isfinite(ceiling).any():
            gap = min(gap, float(np.nanmin(ceiling - under[:, 2])))
    return gap


def _least_gap_below(vertices: Array, terrain: Terrain, band_m: float) -> float:
    """Least height of the lowest vertices [N, 3] above the ground; inf where there is none below any."""
    z = vertices[:, 2]
    points = vertices[z <= z.min() + band_m]
    gap = np.inf
    for part in (points[:, 2] <= z.min() + FIRST_LOOK_M, points[:, 2] > z.min() + FIRST_LOOK_M):
        # Where the highest of all ground leaves more than the gap that is known, no vertex lies nearer.
        tried = points[part & (points[:, 2] - terrain.vertices[:, 2].max() < gap)]
        ground = heights_at(tried[:, :2], terrain)
        if np.isfinite(ground).any():
            gap = min(gap, float(np.nanmin(tried[:, 2] - ground)))
    return gap
