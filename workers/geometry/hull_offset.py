"""Inward offset of a convex hull by the margin that a collision engine adds to it again."""

from typing import NamedTuple

import manifold3d
import numpy as np
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection, QhullError

from schemas.base import Array
from schemas.scene.shape import Hull
from workers.geometry.manifold import hold_to_one_thread

SAME = 1e-9
"""Difference in each coordinate below which normals are equal, and, as a share of the size, vertices."""

ROUNDING = 1e-12
"""Distance of a vertex from a plane that it lies on, as a share of the size: rounding."""

MOST_OF_WIDTH = 0.25
"""Upper limit of the offset as a share of the least width: half of the width is left, however thin the body is."""

MOST_OF_RADIUS = 0.75
"""Upper limit of the offset as a share of the inscribed radius: a quarter of its width leaves no regular tetrahedron."""

LEAST_OFFSET_M = 1e-8
"""Least offset that is made: thinner bodies (a sheet, a hull of Qhull's QJ) are left as they are."""

MOST_GROWTH = 2
"""Upper limit of vertices as a multiple of the hull's. A corner where k faces meet may open into k - 2, up to four times as
many; the nearest are merged then, and some planes are missed by about the distance of those merged."""

FEW = 256
"""Number of vertices that are kept in any case."""

COARSER = 1e-7
"""Grid, as a share of the size, on which vertices are merged first where there are too many; then four times that."""

SCATTER = np.array([0.5773502691896258, 0.7320508075688772, 0.3618033988749895])
"""A direction outside the symmetries of common shapes: sorted along it, equal rows are neighbours."""


class OffsetHull(NamedTuple):
    """Vertices [M, 3], metres, of the smaller body, and the distance that its faces were moved inwards, metres."""

    vertices: Array
    offset_m: float


def offset_hull(hull: Hull, by_m: float) -> OffsetHull:
    """The convex body that remains when every face of the hull moves inwards by `by_m`, or by less where it is too thin.

    With a margin of `offset_m` about it (its Minkowski sum with a ball of that radius) it lies inside the hull, and
    touches the plane of every face that remains; a face between rounded edges narrower than the offset may vanish.
    `MOST_OF_WIDTH` limits the offset; a sheet is returned unchanged, with 0. At most `FEW` vertices, or `MOST_GROWTH` times
    the hull's. By duality: the corners of an intersection of half-spaces are the faces of the hull of their poles
    (Preparata and Muller 1979).
    """
    normals = hull.normals[_distinct(hull.normals, SAME)]
    along = hull.vertices @ normals.T
    reach = along.max(axis=0)
    offset = min(by_m, MOST_OF_WIDTH * float((reach - along.min(axis=0)).min()))
    if offset < LEAST_OFFSET_M:
        return OffsetHull(hull.vertices, 0.0)
    centre = hull.vertices.mean(axis=0)
    radius = float((reach - normals @ centre).min())
    if offset > MOST_OF_RADIUS * radius:
        centre, radius = _largest_ball(normals, reach, centre)
        offset = min(offset, MOST_OF_RADIUS * radius)
    try:
        vertices = _corners(normals, reach - offset - normals @ centre, hull.vertices - centre)
    except QhullError:  # shrunk towards the middle, every plane moves by `offset` at least
        return OffsetHull(centre + (1.0 - offset / radius) * (hull.vertices - centre), offset)
    return OffsetHull(_merge_vertices(vertices, max(FEW, MOST_GROWTH * len(hull.vertices))) + centre, offset)


def least_width_m(hull: Hull) -> float:
    """The least distance, metres, between the plane of a face and the vertex farthest from it.

    Two crossing edges may be nearer: a regular tetrahedron's are by 13 %.
    """
    along = hull.vertices @ hull.normals[_distinct(hull.normals, SAME)].T
    return float((along.max(axis=0) - along.min(axis=0)).min())


def _distinct(rows: Array, near: float) -> Array:
    """[M] ascending indices of rows [N, 3], one of those that are equal to within `near` in each coordinate."""
    order = np.argsort(rows @ SCATTER, kind="stable")
    ranked = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (np.abs(ranked[1:] - ranked[:-1]) > near).any(axis=1)
    return np.sort(order[new])


def _merge_vertices(vertices: Array, most: int) -> Array:
    """[M, 3]: one vertex at each place, and one in each cell of ever coarser grids while they are too many."""
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    vertices, near = vertices[_distinct(vertices, SAME * size)], COARSER * size
    while len(vertices) > most:
        vertices, near = vertices[_distinct(np.floor(vertices / near), 0.5)], 4.0 * near
    return vertices


def _largest_ball(normals: Array, reach: Array, inside: Array) -> tuple[Array, float]:
    """Centre [3] and radius of the largest ball in the body n . x <= reach (Chebyshev centre, a linear program)."""
    room = reach - normals @ inside
    scale = float(room.max())
    found = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack([normals, np.ones(len(normals))]),
        b_ub=room / scale,
        bounds=[(None, None)] * 3 + [(0.0, None)],
        method="highs-ds",
    )
    centre = inside + scale * found.x[:3]
    return centre, float((reach - normals @ centre).min())


def _corners(normals: Array, room: Array, points: Array) -> Array:
    """[M, 3]: the vertices of n . x <= room, which contains the origin; `points` of the body tell how it is stretched.

    manifold3d finds the hull of the poles two to ten times as fast as Qhull, but leaves out poles that hardly stand out,
    and of many planes through one point it may pick three that are nearly parallel. So its corners are compared with
    every plane, and Qhull takes over where a corner lies beyond one.
    """
    _, axes = np.linalg.eigh(points.T @ points)
    to_body = axes * np.abs(points @ axes).max(axis=0)  # the body is as thick in every direction there
    poles = normals @ to_body / room[:, None]
    hold_to_one_thread()
    mesh = manifold3d.Manifold.hull_points(poles).to_mesh64()
    a, b, c = np.array(mesh.vert_properties)[np.asarray(mesh.tri_verts, dtype=np.int64).T]
    bc = np.cross(b, c)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        corners = (bc + np.cross(c, a) + np.cross(a, b)) / (a * bc).sum(axis=1)[:, None] @ to_body.T
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    corners = corners[_distinct(corners, SAME * size)]
    beyond = corners @ normals.T
    beyond -= room
    # nan compares false; a plane without a corner, though its pole is a corner of the hull of poles, lost its corners
    touched = np.count_nonzero(beyond.max(axis=0) >= -ROUNDING * size) >= len(mesh.vert_properties)
    if beyond.max() <= ROUNDING * size and touched:
        return corners
    stretched = np.column_stack([normals @ to_body, -room])
    return HalfspaceIntersection(stretched, np.zeros(3)).intersections @ to_body.T
