"""Elevation of a mesh above points of the plane, and the vertical gap between two meshes."""

from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.convexity import triangle_corners
from workers.geometry.jit import compiled

EDGE_SLACK = 1e-12
"""Barycentric slack, so that a point on the edge of two triangles lies in at least one of them."""

SAME_HEIGHT_M = 1e-9
"""A vertex this near the highest crossing of its vertical line is the top of its mesh there."""

FIRST_BAND_M = 1e-4
"""Vertices this near the lowest one are compared with the ground first: they settle the gap of an object that stands."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """A mesh prepared for many queries of its elevation, with its F triangles that are not vertical.

    vertices [V, 3]; corners a, b, c, each [F, 3]; area [F], twice that in the plane; low and high [F, 3], the bounds.
    """

    vertices: Array
    corners: tuple[Array, Array, Array]
    area: Array
    low: Array
    high: Array


def prepare_terrain(mesh: Mesh) -> Terrain:
    """A mesh prepared for `sample_elevation`, without its vertical triangles, whose edges belong to neighbours."""
    a, b, c = triangle_corners(mesh)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    level = np.abs(area) > 1e-18
    a, b, c = a[level], b[level], c[level]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    return Terrain(mesh.vertices, (a, b, c), area[level], low, high)


def sample_elevation(points_xy: Array, ground: Mesh | Terrain, highest: bool = True) -> Array:
    """[N] float64 metres: the highest, or the lowest, crossing of the mesh with vertical lines; nan where there is none.

    points_xy [N, 2] metres.
    """
    if len(points_xy) == 0:
        return np.empty(0)
    terrain = prepare_terrain(ground) if isinstance(ground, Mesh) else ground
    low, high = points_xy.min(axis=0), points_xy.max(axis=0)
    near = np.flatnonzero(((terrain.low[:, :2] <= high) & (terrain.high[:, :2] >= low)).all(axis=1))
    a, b, c = (corner[near] for corner in terrain.corners)
    return _crossings(np.ascontiguousarray(points_xy), a, b, c, terrain.area[near], highest)


@compiled
def _crossings(points: Array, a: Array, b: Array, c: Array, area: Array, highest: bool) -> Array:
    """[N] the highest or the lowest height at which vertical lines cross triangles [F, 3]; nan where they miss all."""
    found = np.full(len(points), np.nan)
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        for f in range(len(a)):
            wb = ((x - a[f, 0]) * (c[f, 1] - a[f, 1]) - (y - a[f, 1]) * (c[f, 0] - a[f, 0])) / area[f]
            if not wb >= -EDGE_SLACK:
                continue
            wc = ((b[f, 0] - a[f, 0]) * (y - a[f, 1]) - (b[f, 1] - a[f, 1]) * (x - a[f, 0])) / area[f]
            if wc >= -EDGE_SLACK and wb + wc <= 1.0 + EDGE_SLACK:
                z = a[f, 2] + wb * (b[f, 2] - a[f, 2]) + wc * (c[f, 2] - a[f, 2])
                if not (found[n] >= z if highest else found[n] <= z):
                    found[n] = z
    return found


def vertical_gap(upper: Mesh, lower: Mesh | Terrain, band_m: float = 0.02) -> float:
    """Least vertical distance from `upper` down to `lower`, metres; negative where it reaches into it.

    Both in world coordinates, the first standing on top of the second. Vertices of each are compared with faces of the
    other; that is exact unless the nearest features are two crossing edges. Of the upper mesh only vertices within
    `band_m` of its lowest point are tried. inf where nothing is above anything.
    """
    terrain = prepare_terrain(lower) if isinstance(lower, Mesh) else lower
    gap = _least_gap_below(upper.vertices, terrain, band_m)
    bottom, top = upper.vertices.min(axis=0), upper.vertices.max(axis=0)
    # The gap above a vertex of the lower mesh is at least its distance to the lowest point of the upper one.
    under = terrain.vertices[bottom[2] - terrain.vertices[:, 2] < gap]
    under = under[((under[:, :2] >= bottom[:2]) & (under[:, :2] <= top[:2])).all(axis=1)]
    if len(under):
        under = under[under[:, 2] >= sample_elevation(under[:, :2], terrain) - SAME_HEIGHT_M]
        ceiling = sample_elevation(under[:, :2], upper, highest=False)
        gap = float(np.fmin.reduce(ceiling - under[:, 2], initial=gap))
    return gap


def _least_gap_below(vertices: Array, terrain: Terrain, band_m: float) -> float:
    """Least height of the lowest vertices [N, 3] above the ground; inf where there is none below any."""
    z = vertices[:, 2]
    points = vertices[z <= z.min() + band_m]
    gap = np.inf
    for part in (points[:, 2] <= z.min() + FIRST_BAND_M, points[:, 2] > z.min() + FIRST_BAND_M):
        # A vertex at least the known gap above the terrain's highest point cannot lessen the gap.
        tried = points[part & (points[:, 2] - terrain.vertices[:, 2].max() < gap)]
        gap = float(np.fmin.reduce(tried[:, 2] - sample_elevation(tried[:, :2], terrain), initial=gap))
    return gap
