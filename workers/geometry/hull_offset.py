"""A convex body made smaller by the margin that a collision engine puts about it again. Pure."""

from typing import NamedTuple

import manifold3d
import numpy as np
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection, QhullError

from schemas.base import Array
from schemas.scene.shape import Hull
from workers.geometry.manifold import hold_to_one_thread

SAME = 1e-9
"""Normals whose coordinates differ by less are of one face; vertices nearer than this share of the size are one."""

ROUNDING = 1e-12
"""Share of the size by which a vertex that lies on a plane may seem to lie off it."""

MOST_OF_WIDTH = 0.25
"""A body is made smaller by at most this share of its least width: half of it is left, however thin it is."""

MOST_OF_RADIUS = 0.75
"""And by at most this share of the radius of the largest ball in it: a quarter of its width leaves no regular tetrahedron."""

LEAST_INSET_M = 1e-8
"""What could only be made smaller by less than this (a sheet, a hull of Qhull's QJ) is left as it is."""

MOST_GROWTH = 2
"""A corner where k faces meet may open into k - 2, which makes up to four times as many. With more vertices than this many
times the hull's, the nearest to one another are merged, and some planes are missed by about how far these lie apart."""

FEW = 256
"""So many vertices are kept whatever the hull has."""

COARSER = 1e-7
"""Of the size: how near vertices are merged first where there are too many; then four times as near, and so on."""

SCATTER = np.array([0.5773502691896258, 0.7320508075688772, 0.3618033988749895])
"""A direction in no symmetry of common shapes: equal rows are neighbours when rows are sorted along it."""


class Inset(NamedTuple):
    """Vertices [M, 3] metres of the smaller body, and by how much its faces were moved, metres, at most what was asked."""

    vertices: Array
    inset_m: float


def inset_hull(hull: Hull, by_m: float) -> Inset:
    """The convex body that is left when every face of the hull moves inwards by `by_m`.

    With a margin of `inset_m` about it (its Minkowski sum with a ball of that radius) it lies inside the hull, and
    touches the plane of every face that is left; a face between rounded edges narrower than the move may be gone. It is
    moved by less where the body is too thin, see `MOST_OF_WIDTH`, and then `inset_m` tells by how much; a sheet comes
    back as it is, with 0. At most `FEW` vertices, or `MOST_GROWTH` times the hull's. By duality: the corners of an
    intersection of half-spaces are the faces of the hull of their poles (Preparata and Muller 1979).
    """
    normals = hull.normals[_distinct(hull.normals, SAME)]
    along = hull.vertices @ normals.T
    reach = along.max(axis=0)
    inset = min(by_m, MOST_OF_WIDTH * float((reach - along.min(axis=0)).min()))
    if inset < LEAST_INSET_M:
        return Inset(hull.vertices, 0.0)
    centre = hull.vertices.mean(axis=0)
    radius = float((reach - normals @ centre).min())
    if inset > MOST_OF_RADIUS * radius:
        centre, radius = _largest_ball(normals, reach, centre)
        inset = min(inset, MOST_OF_RADIUS * radius)
    try:
        vertices = _corners(normals, reach - inset - normals @ centre, hull.vertices - centre)
    except QhullError:  # shrunk towards the middle, every plane moves by `inset` at least
        return Inset(centre + (1.0 - inset / radius) * (hull.vertices - centre), inset)
    return Inset(_fewer(vertices, max(FEW, MOST_GROWTH * len(hull.vertices))) + centre, inset)


def least_width_m(hull: Hull) -> float:
    """The object's thinnest extent, metres: the least distance between the plane of a face and the vertex farthest from it.

    Two edges across one another may be nearer: a regular tetrahedron's are by 13 %.
    """
    along = hull.vertices @ hull.normals[_distinct(hull.normals, SAME)].T
    return float((along.max(axis=0) - along.min(axis=0)).min())


def _distinct(rows: Array, near: float) -> Array:
    """[M] indices, ascending, of rows [N, 3] without those that repeat another to within `near` in each coordinate."""
    order = np.argsort(rows @ SCATTER, kind="stable")
    ranked = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (np.abs(ranked[1:] - ranked[:-1]) > near).any(axis=1)
    return np.sort(order[new])


def _fewer(vertices: Array, most: int) -> Array:
    """[M, 3]: one of those vertices that lie at one place, and of those that are nearest while they are too many."""
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
    """[M, 3]: the vertices of n . x <= room, which holds the origin; `points` of the body say how it is stretched.

    manifold3d finds the hull of the poles two to ten times as fast as Qhull, but leaves out poles that hardly stand out,
    and of many planes through one point it may name three that are nearly parallel. So what it finds is held against
    every plane, and the body is left to Qhull where a corner lies beyond one.
    """
    _, axes = np.linalg.eigh(points.T @ points)
    to_body = axes * np.abs(points @ axes).max(axis=0)  # the body is as thick in every direction there
    poles = normals @ to_body / room[:, None]
    hold_to_one_thread()
    mesh = manifold3d.Manifold.hull_points(poles).to_mesh64()
    a, b, c = np.array(mesh.vert_properties)[np.asarray(mesh.tri_verts, dtype=np.int64).T]
    bc = _cross(b, c)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        corners = (bc + _cross(c, a) + _cross(a, b)) / (a * bc).sum(axis=1)[:, None] @ to_body.T
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    corners = corners[_distinct(corners, SAME * size)]
    beyond = corners @ normals.T
    beyond -= room
    # nan compares false; a plane that is touched nowhere, though its pole is a corner of the hull, lost its corners
    touched = np.count_nonzero(beyond.max(axis=0) >= -ROUNDING * size) >= len(mesh.vert_properties)
    if beyond.max() <= ROUNDING * size and touched:
        return corners
    stretched = np.column_stack([normals @ to_body, -room])
    return HalfspaceIntersection(stretched, np.zeros(3)).intersections @ to_body.T


def _cross(a: Array, b: Array) -> Array:
    """[N, 3]: as numpy's, without its checks."""
    return np.stack(
        [a[:, (k + 1) % 3] * b[:, (k + 2) % 3] - a[:, (k + 2) % 3] * b[:, (k + 1) % 3] for k in range(3)], 1
    )
