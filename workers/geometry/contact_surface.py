"""The features of a mesh that may touch another: corners, edges and faces, each with what is about it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.contact_kernels import SLOPE, Index
from workers.geometry.convexity import weld

FLAT = 1e-9
"""One minus the cosine between two faces, below which there is no edge between them."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A welded mesh with the neighbours of its features.

    vertices [V, 3] metres; faces [F, 3]; side [F]: 1 where all about a face lies below its plane as it is wound, -1 where
    all lies above, 0 where neither or both, and on a surface that is not closed, which has no inside. corners [C]:
    vertices that are not within a plane; edges [E, 2] that bend or bound, across [E, 2]: the vertices beside them (twice the
    same at one triangle); starts [V + 1] and members: the neighbours of each vertex.
    """

    vertices: Array
    faces: Index
    side: Index
    corners: Index
    edges: Index
    across: Index
    starts: Index
    members: Index


def surface_of(mesh: Mesh, closed: bool) -> Surface:
    """The features of a mesh, or of a part of one that is `closed`, whichever way its faces are wound."""
    mesh = weld(mesh)
    vertices, faces = np.ascontiguousarray(mesh.vertices, dtype=np.float64), mesh.faces.astype(np.int64)
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    doubled = np.linalg.norm(normals, axis=1)
    faces, normals = faces[doubled > 0.0], normals[doubled > 0.0] / doubled[doubled > 0.0, None]
    starts, members = _star(faces, len(vertices))
    edges, across = _bent_edges(vertices, faces, normals)
    side = _sides(vertices, faces, normals, starts, members) if closed else np.zeros(len(faces), dtype=np.int64)
    return Surface(vertices, faces, side, np.unique(edges), edges, across, starts, members)


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge of a mesh has two faces or more, once its vertices at one place are one."""
    mesh = weld(mesh)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    return bool((np.unique(edges @ [len(mesh.vertices), 1], return_counts=True)[1] > 1).all())


def crop(mesh: Mesh, low: Array, high: Array) -> Mesh:
    """The triangles that overlap a box, bounds [3] and [3], with all that may share a corner with one of them."""
    corners = mesh.vertices[mesh.faces]
    least, most = corners.min(axis=1), corners.max(axis=1)
    near = ((least <= high) & (most >= low)).all(axis=1)
    if near.any():
        near = ((least <= most[near].max(axis=0)) & (most >= least[near].min(axis=0))).all(axis=1)
    return Mesh(mesh.vertices, mesh.faces[near])


def _star(faces: Index, count: int) -> tuple[Index, Index]:
    """(starts [count + 1], members): the neighbours of each vertex, one after the other."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = np.unique(np.concatenate([pairs[:, 0] * count + pairs[:, 1], pairs[:, 1] * count + pairs[:, 0]]))
    return np.searchsorted(keys // count, np.arange(count + 1)).astype(np.int64), keys % count


def _sides(vertices: Array, faces: Index, normals: Array, starts: Index, members: Index) -> Index:
    """[F]: on which side of a face's plane everything about its corners lies, to within `SLOPE`."""
    below, above = np.ones(len(faces), dtype=np.bool_), np.ones(len(faces), dtype=np.bool_)
    for k in range(3):
        corner = faces[:, k]
        count = starts[corner + 1] - starts[corner]
        face = np.repeat(np.arange(len(faces)), count)
        at = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(starts[corner], count)
        line = vertices[members[at]] - vertices[corner[face]]
        up, slack = (line * normals[face]).sum(axis=1), SLOPE * np.linalg.norm(line, axis=1)
        np.logical_and.at(below, face, up <= slack)
        np.logical_and.at(above, face, up >= -slack)
    return below.astype(np.int64) - above.astype(np.int64)


def _bent_edges(vertices: Array, faces: Index, normals: Array) -> tuple[Index, Index]:
    """Edges [E, 2] that are not between two coplanar faces, and the vertices across them [E, 2]."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    across, face = faces[:, [2, 0, 1]].ravel(), np.repeat(np.arange(len(faces)), 3)
    key = edges[:, 0] * len(vertices) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    key, edges, across, face = key[order], edges[order], across[order], face[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    last = np.append(first, len(edges))[1:] - 1
    flat = (last == first + 1) & (np.abs((normals[face[first]] * normals[face[last]]).sum(axis=1)) > 1.0 - FLAT)
    across_first, across_last = across[first], across[last]
    # Two faces folded onto one another are coplanar, and their edge is bent all the same
    folded = flat & (across_first != across_last) & _same_side(vertices, edges[first], across_first, across_last)
    kept = ~flat | folded
    return edges[first][kept], np.stack([across_first, across_last], axis=1)[kept]


def _same_side(vertices: Array, edges: Index, a: Index, b: Index) -> NDArray[np.bool_]:
    start, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    one, other = np.cross(along, vertices[a] - start), np.cross(along, vertices[b] - start)
    return (one * other).sum(axis=1) > 0.0
