"""Triangle meshes of a merged surface: extraction, cutting, loose parts, normals."""

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.capture.tsdf import Volume

EMPTY = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))


def extract_surface(volume: Volume) -> Mesh:
    """The surface at distance 0 between voxels that were seen, wound outwards, board frame (Lewiner's marching cubes)."""
    seen = volume.weight > 0.0
    if not ((volume.distance_m > 0.0) & seen).any() or not ((volume.distance_m < 0.0) & seen).any():
        return EMPTY
    try:
        vertices, faces, _, _ = marching_cubes(
            volume.distance_m, 0.0, mask=_whole_cells(seen), allow_degenerate=False, gradient_direction="descent"
        )
    except RuntimeError:  # no surface in the cells that were seen
        return EMPTY
    return Mesh(volume.origin + volume.voxel_m * vertices.astype(np.float64), faces.astype(np.int32))


def _whole_cells(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[X, Y, Z] bool: voxels at the far corner of a cell whose eight voxels were seen, as skimage reads its mask."""
    whole = np.zeros_like(seen)
    cell = seen[1:, 1:, 1:].copy()
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                stop = [n - 1 + d for n, d in zip(seen.shape, (i, j, k), strict=True)]
                cell &= seen[i : stop[0], j : stop[1], k : stop[2]]
    whole[1:, 1:, 1:] = cell
    return whole


def cut_below(mesh: Mesh, plane: tuple[float, float, float], height_m: float) -> Mesh:
    """What is above the plane z = a x + b y + c + height_m; faces across it are cut along it."""
    a, b, c = plane
    normal = np.array([-a, -b, 1.0])
    normal /= np.linalg.norm(normal)
    if not len(mesh.faces):
        return mesh
    vertices, faces, _ = trimesh.intersections.slice_faces_plane(
        mesh.vertices, mesh.faces, normal, np.array([0.0, 0.0, c + height_m])
    )
    return Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32).reshape(-1, 3))


def keep_vertices(mesh: Mesh, keep: NDArray[np.bool_]) -> tuple[Mesh, NDArray[np.int64]]:
    """(the faces whose three vertices are kept, with the vertices that they use; the old numbers of those)."""
    faces = mesh.faces[keep[mesh.faces].all(axis=1)]
    used = np.unique(faces)
    number = np.zeros(len(mesh.vertices), np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    return Mesh(mesh.vertices[used], number[faces]), used.astype(np.int64)


def large_parts(mesh: Mesh, least_share: float) -> NDArray[np.bool_]:
    """[V] bool: vertices of connected parts that have at least a share of the area of the largest one."""
    count = len(mesh.vertices)
    if not len(mesh.faces):
        return np.zeros(count, bool)
    i, j = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    graph = sparse.coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(count, count))
    parts, label = connected_components(graph, directed=False)
    area = np.bincount(label[mesh.faces[:, 0]], weights=face_areas(mesh), minlength=parts)
    large: NDArray[np.bool_] = (area >= least_share * area.max())[label]
    return large


def face_areas(mesh: Mesh) -> Array:
    """[F] areas, m^2."""
    return 0.5 * np.linalg.norm(_face_normals(mesh), axis=1)


def vertex_normals(mesh: Mesh) -> Array:
    """[V, 3] unit normals, the mean of the faces' weighted by their area; up where a vertex has no face."""
    normals = np.zeros((len(mesh.vertices), 3))
    across = _face_normals(mesh)
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, corner], weights=across[:, axis], minlength=len(normals))
    length = np.linalg.norm(normals, axis=1)
    normals[length == 0.0] = [0.0, 0.0, 1.0]
    return normals / np.where(length == 0.0, 1.0, length)[:, None]


def _face_normals(mesh: Mesh) -> Array:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    across: Array = np.cross(b - a, c - a)
    return across
