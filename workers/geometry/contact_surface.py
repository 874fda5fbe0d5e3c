"""The features of a mesh that may touch another: corners, edges and faces, each with what is about it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.contact_kernels import SLOPE, Index, cross
from workers.geometry.convexity import face_normals, numbers_in, weld
from workers.geometry.jit import compiled

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
    normals = face_normals(vertices, faces)
    solid = normals.any(axis=1)
    faces, normals = faces[solid], normals[solid]
    starts, members = _star(faces, len(vertices))
    edges, across = _bent_edges(vertices, faces, normals)
    side = _sides(vertices, faces, normals, starts, members) if closed else np.zeros(len(faces), dtype=np.int64)
    return Surface(vertices, faces, side, numbers_in(edges, len(vertices)), edges, across, starts, members)


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge of a mesh has two faces or more, once its vertices at one place are one."""
    mesh = weld(mesh)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    return bool((np.unique(edges @ [len(mesh.vertices), 1], return_counts=True)[1] > 1).all())


def crop(mesh: Mesh, low: Array, high: Array) -> Mesh:
    """The triangles that overlap a box, bounds [3] and [3], with all that may share a corner with one of them."""
    return Mesh(mesh.vertices, mesh.faces[_near_box(mesh.vertices, mesh.faces, low, high)])


@compiled
def _near_box(vertices: Array, faces: NDArray[np.integer], low: Array, high: Array) -> NDArray[np.bool_]:
    """[F]: whether a face's bounds overlap those of all the faces whose bounds overlap a box."""
    near = np.zeros(len(faces), np.bool_)
    least, most = np.full(3, np.inf), np.full(3, -np.inf)
    for again in range(2):
        down, up = low.astype(np.float64), high.astype(np.float64)
        if again:
            down, up = least.copy(), most.copy()
        for f in range(len(faces)):
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            inside = True
            for k in range(3):
                inside = inside and min(a[k], b[k], c[k]) <= up[k] and max(a[k], b[k], c[k]) >= down[k]
            near[f] = inside
            if inside and not again:
                for k in range(3):
                    least[k], most[k] = min(least[k], a[k], b[k], c[k]), max(most[k], a[k], b[k], c[k])
    return near


@compiled
def _star(faces: Index, count: int) -> tuple[Index, Index]:
    """(starts [count + 1], members): the neighbours of each vertex, one after the other, ascending."""
    keys = np.empty(6 * len(faces), np.int64)
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            keys[6 * f + 2 * k], keys[6 * f + 2 * k + 1] = a * count + b, b * count + a
    keys.sort()
    starts, members, found = np.zeros(count + 1, np.int64), np.empty(len(keys), np.int64), 0
    for n in range(len(keys)):
        if n == 0 or keys[n] != keys[n - 1]:
            members[found] = keys[n] % count
            starts[keys[n] // count + 1] += 1
            found += 1
    return np.cumsum(starts), members[:found]


@compiled
def _sides(vertices: Array, faces: Index, normals: Array, starts: Index, members: Index) -> Index:
    """[F]: on which side of a face's plane everything about its corners lies, to within `SLOPE`."""
    side = np.empty(len(faces), np.int64)
    for f in range(len(faces)):
        below, above = True, True
        for c in range(3):
            corner = faces[f, c]
            for m in range(starts[corner], starts[corner + 1]):
                up = length2 = 0.0
                for k in range(3):
                    line = vertices[members[m], k] - vertices[corner, k]
                    up += line * normals[f, k]
                    length2 += line * line
                slack = SLOPE * np.sqrt(length2)
                below = below and up <= slack
                above = above and up >= -slack
        side[f] = np.int64(below) - np.int64(above)
    return side


@compiled
def _bent_edges(vertices: Array, faces: Index, normals: Array) -> tuple[Index, Index]:
    """Edges [E, 2] that are not between two coplanar faces, and the vertices across them [E, 2]."""
    count = len(vertices)
    keys = np.empty(3 * len(faces), np.int64)
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            keys[3 * f + k] = min(a, b) * count + max(a, b)
    order = np.argsort(keys, kind="mergesort")
    edges, across, found, first = np.empty((len(keys), 2), np.int64), np.empty((len(keys), 2), np.int64), 0, 0
    while first < len(order):
        key, last = keys[order[first]], first
        while last + 1 < len(order) and keys[order[last + 1]] == key:
            last += 1
        one, other = order[first], order[last]
        a, b = key // count, key % count
        p, q = faces[one // 3, (one % 3 + 2) % 3], faces[other // 3, (other % 3 + 2) % 3]
        cosine = 0.0
        for k in range(3):
            cosine += normals[one // 3, k] * normals[other // 3, k]
        flat = last == first + 1 and abs(cosine) > 1.0 - FLAT
        # Two faces folded onto one another are coplanar, and their edge is bent all the same
        if not flat or (p != q and _same_side(vertices, a, b, p, q)):
            edges[found, 0], edges[found, 1] = a, b
            across[found, 0], across[found, 1] = p, q
            found += 1
        first = last + 1
    return edges[:found], across[:found]


@compiled
def _same_side(vertices: Array, a: int, b: int, p: int, q: int) -> bool:
    """Whether two vertices p and q lie on the same side of the edge from a to b, in the plane of all four."""
    one, other = np.empty(3), np.empty(3)
    cross(vertices[b] - vertices[a], vertices[p] - vertices[a], one)
    cross(vertices[b] - vertices[a], vertices[q] - vertices[a], other)
    return bool(one[0] * other[0] + one[1] * other[1] + one[2] * other[2] > 0.0)
