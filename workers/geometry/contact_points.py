"""Where two meshes touch: vertices on faces, and edges across edges. Pure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.contact_kernels import Index, crossings, near_faces, which_side
from workers.geometry.convexity import weld

FLAT = 1e-9
"""One less the cosine between two faces: below this there is no edge between them."""

SAME_M, SAME_NORMAL = 1e-7, 1e-4
"""Contacts nearer than this whose normals differ by less are one."""


@dataclass(frozen=True, eq=False)
class _Side:
    """What of a mesh may touch another: its vertices [V, 3], triangles and edges that are near, and who lies about what.

    faces [F, 3], their corners [F, 3, 3] and unit normals [F, 3] as wound; used [N]: vertices of near triangles; ends
    [E, 2] of edges that bend or bound, about [E, 2] the vertices across the edge (twice the same where there is one
    triangle); star (starts [V + 1], members): the neighbours of each vertex.
    """

    vertices: Array
    faces: Index
    corners: Array
    normals: Array
    used: Index
    ends: Index
    about: Index
    star: tuple[Index, Index]


def touching_points(upper: Mesh, lower: Mesh, within_m: float) -> tuple[Array, Array]:
    """(points [N, 3], unit normals [N, 3]) where two meshes, in one frame, are within `within_m` of one another.

    Normals point from the lower to the upper one. A vertex touches a face, or an edge another, where the plane between
    them has the one body's surface about the contact above it and the other's below, to within `SLOPE` or twice
    `within_m`; so that a corner over the edge of a table touches its top and not its side, whichever way faces are
    wound. Winding decides only where all about a vertex is level.
    """
    sides = _sides(upper, lower, within_m)
    if sides is None:
        return np.empty((0, 3)), np.empty((0, 3))
    above, below = sides
    found = [_vertices_on_faces(above, below, within_m)]
    points, normals = _vertices_on_faces(below, above, within_m)
    found.append((points, -normals))
    found.append(_edges_on_edges(above, below, within_m))
    points, normals = (np.concatenate([pair[k] for pair in found]) for k in (0, 1))
    rounded = np.round(np.concatenate([points / SAME_M, normals / SAME_NORMAL], axis=1))
    kept = np.sort(np.unique(rounded, axis=0, return_index=True)[1])
    return points[kept], normals[kept]


def _sides(upper: Mesh, lower: Mesh, within_m: float) -> tuple[_Side, _Side] | None:
    if not (len(upper.faces) and len(lower.faces)):
        return None
    low = np.maximum(upper.vertices.min(axis=0), lower.vertices.min(axis=0)) - within_m
    high = np.minimum(upper.vertices.max(axis=0), lower.vertices.max(axis=0)) + within_m
    above, below = _side(upper, low, high), _side(lower, low, high)
    return (above, below) if above is not None and below is not None else None


def _cut(mesh: Mesh, low: Array, high: Array) -> Mesh | None:
    """The triangles that reach into a box, and all that have a corner in common with one of them, welded."""
    corners = mesh.vertices[mesh.faces]
    least, most = corners.min(axis=1), corners.max(axis=1)
    near = ((least <= high) & (most >= low)).all(axis=1)
    if not near.any():
        return None
    low, high = least[near].min(axis=0), most[near].max(axis=0)
    return weld(Mesh(mesh.vertices, mesh.faces[((least <= high) & (most >= low)).all(axis=1)]))


def _side(mesh: Mesh, low: Array, high: Array) -> _Side | None:
    """The parts of a mesh that reach into a box; None where there are none."""
    cut = _cut(mesh, low, high)
    if cut is None:
        return None
    mesh = cut
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(across, axis=1)
    near = ((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1) & (doubled > 0.0)
    if not near.any():
        return None
    # Whole stars, also of vertices at the border of what is near
    about = np.isin(mesh.faces, mesh.faces[near]).any(axis=1) & (doubled > 0.0)
    faces = mesh.faces[about].astype(np.int64)
    normals = across[about] / doubled[about, None]
    used = np.unique(mesh.faces[near])
    inside = ((mesh.vertices[used] >= low) & (mesh.vertices[used] <= high)).all(axis=1)
    ends, beside = _bent_edges(mesh, faces, normals)
    ends_in = mesh.vertices[ends]
    kept = ((ends_in.min(axis=1) <= high) & (ends_in.max(axis=1) >= low)).all(axis=1)
    unit = across[near] / doubled[near, None]
    star = _star(faces, len(mesh.vertices))
    near_faces, near_corners = mesh.faces[near].astype(np.int64), np.ascontiguousarray(corners[near])
    return _Side(mesh.vertices, near_faces, near_corners, unit, used[inside], ends[kept], beside[kept], star)


def _star(faces: Index, count: int) -> tuple[Index, Index]:
    """The neighbours of each vertex, one after the other."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    return np.searchsorted(pairs[:, 0], np.arange(count + 1)).astype(np.int64), pairs[:, 1].copy()


def _bent_edges(mesh: Mesh, faces: Index, normals: Array) -> tuple[Index, Index]:
    """Edges [E, 2] that are not between two faces in one plane, and the vertices across them [E, 2]."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    across, face = faces[:, [2, 0, 1]].ravel(), np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, across, face = edges[order], across[order], face[order]
    first = np.flatnonzero(np.r_[True, (edges[1:] != edges[:-1]).any(axis=1)])
    last = np.r_[first[1:], len(edges)] - 1
    flat = (last == first + 1) & (np.abs((normals[face[first]] * normals[face[last]]).sum(axis=1)) > 1.0 - FLAT)
    across_first, across_last = across[first], across[last]
    # Two faces folded onto one another are in one plane, and bent all the same
    folded = flat & (across_first != across_last) & _same_side(mesh.vertices, edges[first], across_first, across_last)
    kept = ~flat | folded
    return edges[first][kept], np.stack([across_first, across_last], axis=1)[kept]


def _same_side(vertices: Array, edges: Index, a: Index, b: Index) -> NDArray[np.bool_]:
    start, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    one, other = np.cross(along, vertices[a] - start), np.cross(along, vertices[b] - start)
    return (one * other).sum(axis=1) > 0.0


def _vertices_on_faces(above: _Side, below: _Side, within_m: float) -> tuple[Array, Array]:
    """Vertices of the first on faces of the second, normals towards the first."""
    points = np.ascontiguousarray(above.vertices[above.used])
    low, high = below.corners.min(axis=1), below.corners.max(axis=1)
    pairs = np.empty((0, 2), dtype=np.int64)
    count = near_faces(points, below.corners, low, high, within_m, pairs)
    pairs = np.empty((count, 2), dtype=np.int64)
    near_faces(points, below.corners, low, high, within_m, pairs)
    vertex, face = above.used[pairs[:, 0]], pairs[:, 1]
    over, under = _sides_of(above, vertex, below.normals[face], within_m)
    # The face's own body must lie on the other side, where the faces about it tell
    around = [_sides_of(below, below.faces[:, k], below.normals, within_m) for k in range(3)]
    on, beneath = (np.logical_and.reduce([one[k] for one in around])[face] for k in (0, 1))
    neither = ~on & ~beneath
    # About the deepest face of a hollow everything rises, as about the underside of a body: there the vertex tells
    upright, turned = over & (beneath | neither | ~under), under & (on | neither)
    sign = np.where(upright, 1.0, -1.0)
    kept = upright | turned
    return points[pairs[kept, 0]], below.normals[face[kept]] * sign[kept, None]


def _sides_of(side: _Side, who: Index, normals: Array, within_m: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether all neighbours of vertices [N] lie above the planes with normals [N, 3] through them, and whether below."""
    over, under = np.ones(len(who), dtype=np.bool_), np.ones(len(who), dtype=np.bool_)
    which_side(side.vertices, np.ascontiguousarray(who), *side.star, normals, within_m, over, under)
    return over, under


def _edges_on_edges(above: _Side, below: _Side, within_m: float) -> tuple[Array, Array]:
    """Where an edge of the first lies across one of the second."""
    if not (len(above.ends) and len(below.ends)):
        return np.empty((0, 3)), np.empty((0, 3))
    a, b = (np.ascontiguousarray(side.vertices[side.ends]) for side in (above, below))
    over, under = (np.ascontiguousarray(side.vertices[side.about]) for side in (above, below))
    count = crossings(a, over, b, under, within_m, np.empty((0, 2, 3)))
    found = np.empty((count, 2, 3))
    crossings(a, over, b, under, within_m, found)
    return found[:, 0], found[:, 1]
