"""A triangle mesh as the judge reads it: welded, with unit normals, neighbours, and the bodies that it bounds."""

from dataclasses import dataclass
from functools import cached_property

import fcl
import manifold3d
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from schemas.base import Array
from schemas.scene.shape import Mesh


@dataclass(frozen=True, eq=False)
class Surface:
    """Welded triangles in world coordinates: vertices [V, 3] metres, faces [F, 3], none of them without area."""

    vertices: Array
    faces: NDArray[np.int64]

    @cached_property
    def corners(self) -> Array:
        """[F, 3, 3]: the corners of every face."""
        return self.vertices[self.faces]

    @cached_property
    def normals(self) -> Array:
        """[F, 3]: unit normals, outwards where the mesh is wound so."""
        return _unit(_area_vectors(self.corners))

    @cached_property
    def _sides(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(edges [E, 2], corners in order; the edges [F, 3] of every face, the k-th opposite its k-th corner)."""
        every = np.sort(self.faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
        edges, inverse = np.unique(every, axis=0, return_inverse=True)
        return edges, inverse.reshape(-1, 3)

    @property
    def edges(self) -> NDArray[np.int64]:
        """[E, 2]: the corners of every edge."""
        return self._sides[0]

    @property
    def face_edges(self) -> NDArray[np.int64]:
        """[F, 3]: the edges of every face."""
        return self._sides[1]

    @cached_property
    def edge_faces(self) -> NDArray[np.int64]:
        """[E, 2]: the first and the last face that has an edge."""
        found = np.zeros((len(self.edges), 2), dtype=np.int64)
        sides, face = self.face_edges.reshape(-1), np.repeat(np.arange(len(self.faces)), 3)
        found[sides[::-1], 0] = face[::-1]
        found[sides, 1] = face
        return found

    @cached_property
    def _faces_at(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        order = np.argsort(self.faces.reshape(-1), kind="stable")
        return order // 3, np.searchsorted(self.faces.reshape(-1)[order], np.arange(len(self.vertices) + 1))

    def faces_at(self, corner: int) -> NDArray[np.int64]:
        """The faces that have a corner."""
        faces, first = self._faces_at
        return faces[first[corner] : first[corner + 1]]

    @cached_property
    def boxes(self) -> tuple[Array, Array]:
        """(lower, upper) corners of every face's bounding box, [F, 3] each."""
        return self.corners.min(axis=1), self.corners.max(axis=1)

    def faces_in(self, box: Array) -> NDArray[np.intp]:
        """The faces whose bounding boxes meet a box [2, 3]."""
        lower, upper = self.boxes
        return np.flatnonzero(((lower <= box[1]) & (upper >= box[0])).all(axis=1))

    @cached_property
    def bounds(self) -> Array:
        """[2, 3]: the bounding box."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def corner_tree(self) -> cKDTree:
        """The corners of faces, for the nearest of them."""
        return cKDTree(self.vertices[np.unique(self.faces)])

    @cached_property
    def tree(self) -> fcl.CollisionObject:
        """The triangles as a hierarchy of boxes, for distances."""
        model = fcl.BVHModel()
        model.beginModel(len(self.vertices), len(self.faces))
        model.addSubModel(self.vertices, self.faces)
        model.endModel()
        return fcl.CollisionObject(model, fcl.Transform())

    @cached_property
    def _pieces(self) -> list[tuple[NDArray[np.intp], manifold3d.Manifold | None]]:
        """The numbers of the faces of every piece, and the body that it bounds, None where it is open."""
        if len(self.faces) == 0:
            return []
        counts = np.bincount(self.face_edges.reshape(-1), minlength=len(self.edges))
        one, other = self.edge_faces[counts == 2].T
        links = coo_matrix((np.ones(len(one)), (one, other)), shape=(len(self.faces),) * 2)
        label = connected_components(links, directed=False)[1]
        members = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
        return [(each, _solid(self.vertices, self.faces[each])) for each in members]

    @property
    def solids(self) -> list[manifold3d.Manifold]:
        """The connected bodies: pieces that share no edge of two faces are apart."""
        return [solid for _, solid in self._pieces if solid is not None]

    @cached_property
    def open(self) -> NDArray[np.bool_]:
        """[F]: whether a face belongs to a piece that bounds no body, so that neither of its sides is the outer one."""
        found = np.zeros(len(self.faces), dtype=bool)
        for members, solid in self._pieces:
            found[members] = solid is None
        return found


def surface(mesh: Mesh) -> Surface:
    """The mesh without faces of no area, welded, and turned outwards where it bounds a body.

    One vertex is kept at each place, and one of faces with the same corners. If that leaves it open: none of these, which
    are common walls; then one vertex at each place of what shares vertices as it is written.
    """
    place = np.unique(mesh.vertices, axis=0, return_inverse=True)[1].reshape(-1)
    once, alone = _welded(mesh, place)
    best = once
    if once.open.any():
        apart = _welded(mesh, place + len(place) * _connected(len(mesh.vertices), mesh.faces))[0]
        best = next((each for each in (alone, apart) if len(each.faces) and not each.open.any()), once)
    turned = best.faces.copy()
    for members, _ in best._pieces:
        if _volume(best.vertices, turned[members]) < 0.0:
            turned[members] = turned[members][:, ::-1]
    return Surface(best.vertices, turned)


def _welded(mesh: Mesh, label: NDArray[np.intp]) -> tuple[Surface, Surface]:
    """(one of the faces with the same corners, where vertices of one label are one; the faces that are alone there)."""
    _, where, inverse = np.unique(label, return_index=True, return_inverse=True)
    places, faces = mesh.vertices[where], inverse.reshape(-1)[mesh.faces].astype(np.int64)
    faces = faces[np.linalg.norm(_area_vectors(places[faces]), axis=1) > 0.0]
    _, first, which, counts = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    return Surface(places, faces[np.sort(first)]), Surface(places, faces[counts[which.reshape(-1)] == 1])


def _connected(count: int, faces: NDArray[np.integer]) -> NDArray[np.intp]:
    """[count]: the number of each vertex's piece, of those that faces join."""
    ends = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.intp)


def _area_vectors(corners: Array) -> Array:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _volume(vertices: Array, faces: NDArray[np.int64]) -> float:
    """The signed volume that faces enclose, by the divergence theorem about their middle."""
    corners = vertices[faces] - vertices[faces].mean(axis=(0, 1))
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)


def _solid(vertices: Array, faces: NDArray[np.int64]) -> manifold3d.Manifold | None:
    """The body inside the faces, wound either way; None where they are open."""
    kept = np.unique(faces)
    points = np.ascontiguousarray(vertices[kept])
    order = faces if _volume(vertices, faces) > 0.0 else faces[:, ::-1]
    index = np.searchsorted(kept, order).astype(np.uint64)
    solid = manifold3d.Manifold(manifold3d.Mesh64(points, np.ascontiguousarray(index)))
    return None if solid.status() != manifold3d.Error.NoError or solid.volume() <= 0.0 else solid
