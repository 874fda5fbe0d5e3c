"""Elevation of a mesh above points of the plane, and the vertical gap between two meshes."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.bounds import bounds_of
from workers.geometry.jit import compiled

EDGE_SLACK = 1e-12
"""Barycentric slack, so that a point on the edge of two triangles lies in at least one of them."""

VERTICAL_M2 = 1e-18
"""Twice the area in the plane up to which a triangle is vertical."""

SAME_HEIGHT_M = 1e-9
"""A vertex this near the highest crossing of its vertical line is the top of its mesh there."""

FIRST_BAND_M = 1e-4
"""Vertices this near the lowest one are compared with the ground first: they settle the gap of an object that stands."""


def sample_elevation(points_xy: Array, ground: Mesh, highest: bool = True) -> Array:
    """[N] float64 metres: the highest, or the lowest, crossing of the mesh with vertical lines; nan where there is none.

    points_xy [N, 2] metres. Vertical triangles are left out: their edges belong to neighbours.
    """
    return _crossings(np.ascontiguousarray(points_xy), ground.vertices, ground.faces, highest)


@compiled
def _crossings(points: Array, vertices: Array, faces: NDArray[np.int32], highest: bool) -> Array:
    """[N] the highest or the lowest height at which vertical lines cross triangles [F, 3]; nan where they miss all."""
    found = np.full(len(points), np.nan)
    left, right, front, back = np.inf, -np.inf, np.inf, -np.inf
    for n in range(len(points)):
        left, right = min(left, points[n, 0]), max(right, points[n, 0])
        front, back = min(front, points[n, 1]), max(back, points[n, 1])
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by = vertices[a, 0], vertices[a, 1], vertices[b, 0], vertices[b, 1]
        cx, cy = vertices[c, 0], vertices[c, 1]
        if min(ax, bx, cx) > right or max(ax, bx, cx) < left or min(ay, by, cy) > back or max(ay, by, cy) < front:
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > VERTICAL_M2:
            continue
        for n in range(len(points)):
            x, y = points[n, 0] - ax, points[n, 1] - ay
            wb = (x * (cy - ay) - y * (cx - ax)) / area
            if not wb >= -EDGE_SLACK:
                continue
            wc = ((bx - ax) * y - (by - ay) * x) / area
            if wc >= -EDGE_SLACK and wb + wc <= 1.0 + EDGE_SLACK:
                az = vertices[a, 2]
                z = az + wb * (vertices[b, 2] - az) + wc * (vertices[c, 2] - az)
                if not (found[n] >= z if highest else found[n] <= z):
                    found[n] = z
    return found


def vertical_gap(upper: Mesh, lower: Mesh, band_m: float = 0.02) -> float:
    """Least vertical distance from `upper` down to `lower`, metres; negative where it reaches into it.

    Both in world coordinates, the first standing on top of the second. Vertices of each are compared with faces of the
    other; that is exact unless the nearest features are two crossing edges. Of the upper mesh only vertices within
    `band_m` of its lowest point are tried. inf where nothing is above anything.
    """
    gap = _least_gap_below(upper.vertices, lower, band_m)
    bottom, top = bounds_of(upper.vertices)
    # The gap above a vertex of the lower mesh is at least its distance to the lowest point of the upper one.
    under = lower.vertices[bottom[2] - lower.vertices[:, 2] < gap]
    under = under[((under[:, :2] >= bottom[:2]) & (under[:, :2] <= top[:2])).all(axis=1)]
    if len(under):
        under = under[under[:, 2] >= sample_elevation(under[:, :2], lower) - SAME_HEIGHT_M]
        ceiling = sample_elevation(under[:, :2], upper, highest=False)
        gap = float(np.fmin.reduce(ceiling - under[:, 2], initial=gap))
    return gap


def _least_gap_below(vertices: Array, ground: Mesh, band_m: float) -> float:
    """Least height of the lowest vertices [N, 3] above the ground; inf where there is none below any."""
    z = vertices[:, 2]
    points = vertices[z <= z.min() + band_m]
    gap = np.inf
    for part in (points[:, 2] <= z.min() + FIRST_BAND_M, points[:, 2] > z.min() + FIRST_BAND_M):
        # A vertex at least the known gap above the ground's highest point cannot lessen the gap.
        tried = points[part & (points[:, 2] - ground.vertices[:, 2].max() < gap)]
        gap = float(np.fmin.reduce(tried[:, 2] - sample_elevation(tried[:, :2], ground), initial=gap))
    return gap
