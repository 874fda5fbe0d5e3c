"""Contact points of two meshes: vertices on faces, and edges across edges."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.contact_kernels import Index, clear_opposite_sides, find_edge_crossings, find_near_faces
from workers.geometry.convexity import weld

FLAT = 1e-9
"""One minus the cosine between two faces, below which there is no edge between them."""

SAME_M, SAME_NORMAL = 1e-7, 1e-4
"""Distance between contacts, and difference between their normals, below which they are one."""


@dataclass(frozen=True, eq=False)
class _Surface:
    """The features of a mesh that may touch another one, and their neighbours.

    vertices [V, 3]; faces [F, 3], their corners [F, 3, 3] and unit normals [F, 3] as wound; used [N]: vertices of faces;
    edges [E, 2] that bend or bound, across [E, 2] the vertices beside them (twice the same at one triangle); star (starts
    [V + 1], members): the neighbours of each vertex.
    """

    vertices: Array
    faces: Index
    corners: Array
    normals: Array
    used: Index
    edges: Index
    across: Index
    star: tuple[Index, Index]


def find_contact_points(upper: Mesh, lower: Mesh, within_m: float) -> tuple[Array, Array]:
    """(points [N, 3], unit normals [N, 3]) where two meshes, in one frame, are within `within_m` of one another.

    Normals point from the lower to the upper one. A vertex touches a face, or an edge another, where the plane between
    them has the one body's surface about the contact above it and the other's below, to within `SLOPE` or twice
    `within_m`; so that a corner over the edge of a table touches its top and not its side, whichever way faces are
    wound. Winding decides only where everything about a vertex is level.
    """
    none = np.empty((0, 3)), np.empty((0, 3))
    if not (len(upper.faces) and len(lower.faces)):
        return none
    low = np.maximum(upper.vertices.min(axis=0), lower.vertices.min(axis=0)) - within_m
    high = np.minimum(upper.vertices.max(axis=0), lower.vertices.max(axis=0)) + within_m
    above, below = _surface_in(upper, low, high), _surface_in(lower, low, high)
    if above is None or below is None:
        return none
    on_lower, on_upper = _vertices_on_faces(above, below, within_m), _vertices_on_faces(below, above, within_m)
    crossed = _edges_on_edges(above, below, within_m)
    points = np.concatenate([on_lower[0], on_upper[0], crossed[0]])
    normals = np.concatenate([on_lower[1], -on_upper[1], crossed[1]])
    rounded = np.round(np.concatenate([points / SAME_M, normals / SAME_NORMAL], axis=1))
    kept = np.sort(np.unique(rounded, axis=0, return_index=True)[1])
    return points[kept], normals[kept]


def _overlap(points: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """[N] bool: whether the bounds of points [N, K, 3] overlap a box."""
    overlap: NDArray[np.bool_] = ((points.min(axis=1) <= high) & (points.max(axis=1) >= low)).all(axis=1)
    return overlap


def _crop(mesh: Mesh, low: Array, high: Array) -> Mesh | None:
    """The triangles that overlap a box, and all that have a corner in common with one of them, welded."""
    corners = mesh.vertices[mesh.faces]
    near = corners[_overlap(corners, low, high)]
    if not len(near):
        return None
    return weld(Mesh(mesh.vertices, mesh.faces[_overlap(corners, near.min(axis=(0, 1)), near.max(axis=(0, 1)))]))


def _surface_in(whole: Mesh, low: Array, high: Array) -> _Surface | None:
    """The features of a mesh that overlap a box; None where there are none."""
    mesh = _crop(whole, low, high)
    if mesh is None:
        return None
    corners, faces = mesh.vertices[mesh.faces], mesh.faces.astype(np.int64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    solid = doubled > 0.0
    near = _overlap(corners, low, high) & solid
    if not near.any():
        return None
    normals[solid] /= doubled[solid, None]
    # Whole stars, also of vertices at the border of what is near
    about = np.isin(faces, faces[near]).any(axis=1) & solid
    used = np.unique(faces[near])
    used = used[_overlap(mesh.vertices[used, None], low, high)]
    edges, across = _bent_edges(mesh, faces[about], normals[about])
    kept = _overlap(mesh.vertices[edges], low, high)
    star = _star(faces[about], len(mesh.vertices))
    return _Surface(mesh.vertices, faces[near], corners[near], normals[near], used, edges[kept], across[kept], star)


def _star(faces: Index, count: int) -> tuple[Index, Index]:
    """(starts [count + 1], members): the neighbours of each vertex, one after the other."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    return np.searchsorted(pairs[:, 0], np.arange(count + 1)).astype(np.int64), pairs[:, 1].copy()


def _bent_edges(mesh: Mesh, faces: Index, normals: Array) -> tuple[Index, Index]:
    """Edges [E, 2] that are not between two coplanar faces, and the vertices across them [E, 2]."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    across, face = faces[:, [2, 0, 1]].ravel(), np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, across, face = edges[order], across[order], face[order]
    first = np.flatnonzero(np.r_[True, (edges[1:] != edges[:-1]).any(axis=1)])
    last = np.r_[first[1:], len(edges)] - 1
    flat = (last == first + 1) & (np.abs((normals[face[first]] * normals[face[last]]).sum(axis=1)) > 1.0 - FLAT)
    across_first, across_last = across[first], across[last]
    # Two faces folded onto one another are coplanar, and their edge is bent all the same
    folded = flat & (across_first != across_last) & _same_side(mesh.vertices, edges[first], across_first, across_last)
    kept = ~flat | folded
    return edges[first][kept], np.stack([across_first, across_last], axis=1)[kept]


def _same_side(vertices: Array, edges: Index, a: Index, b: Index) -> NDArray[np.bool_]:
    start, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    one, other = np.cross(along, vertices[a] - start), np.cross(along, vertices[b] - start)
    return (one * other).sum(axis=1) > 0.0


def _vertices_on_faces(above: _Surface, below: _Surface, within_m: float) -> tuple[Array, Array]:
    """Vertices of the first on faces of the second, normals towards the first."""
    points, low, high = above.vertices[above.used], below.corners.min(axis=1), below.corners.max(axis=1)
    pairs = find_near_faces(points, below.corners, low, high, within_m)
    face, faces = pairs[:, 1], below.normals
    over, under = _lie_beside(above, above.used[pairs[:, 0]], faces[face], within_m)
    # The face's own body must lie on the other side, where the faces about it tell
    around = [_lie_beside(below, below.faces[:, k], faces, within_m) for k in range(3)]
    on, beneath = (np.logical_and.reduce([one[k] for one in around])[face] for k in (0, 1))
    neither = ~on & ~beneath
    # About the deepest face of a hollow everything rises, as about the underside of a body: there the vertex tells
    upright, turned = over & (beneath | neither | ~under), under & (on | neither)
    kept = upright | turned
    return points[pairs[kept, 0]], faces[face[kept]] * np.where(upright, 1.0, -1.0)[kept, None]


def _lie_beside(side: _Surface, chosen: Index, normals: Array, within_m: float) -> tuple[NDArray[np.bool_], ...]:
    """Whether all neighbours of vertices [N] lie above the planes with normals [N, 3] through them, and whether below."""
    over, under = np.ones(len(chosen), dtype=np.bool_), np.ones(len(chosen), dtype=np.bool_)
    clear_opposite_sides(side.vertices, np.ascontiguousarray(chosen), *side.star, normals, within_m, over, under)
    return over, under


def _edges_on_edges(above: _Surface, below: _Surface, within_m: float) -> tuple[Array, Array]:
    """Crossings of an edge of the first with one of the second."""
    a, b = above.vertices[above.edges], below.vertices[below.edges]
    found = find_edge_crossings(a, above.vertices[above.across], b, below.vertices[below.across], within_m)
    return found[:, 0], found[:, 1]
