"""Masks of the object: the silhouette of the merged surface, down to the board."""

import numpy as np
from numpy.typing import NDArray

from schemas.scene.camera import Camera
from schemas.scene.shape import Mesh
from workers.capture.object_region import Ground
from workers.geometry.zbuffer import draw_depth

RIM_M = 0.0005
"""Points of an open edge that lie nearer to the cut above the board than this are on it."""


def silhouette(mesh: Mesh, camera: Camera) -> NDArray[np.bool_]:
    """[H, W] bool: the pixels whose centres see the mesh; nothing hides it, because nothing else stands on the board."""
    return draw_depth(mesh, camera) > 0.0


def down_to_board(mesh: Mesh, ground: Ground) -> Mesh:
    """The mesh with walls from its cut edge down to the board: the object goes on below the clearance."""
    edges = _open_edges(mesh)
    height = ground.height_m(mesh.vertices)
    edges = edges[(height[edges] < ground.clearance_m + RIM_M).all(axis=1)]
    if not len(edges):
        return mesh
    a, b, c = ground.plane
    rim, local = np.unique(edges, return_inverse=True)
    foot = mesh.vertices[rim].copy()
    foot[:, 2] = a * foot[:, 0] + b * foot[:, 1] + c
    low = local.reshape(-1, 2) + len(mesh.vertices)
    upper = np.stack([edges[:, 1], edges[:, 0], low[:, 0]], axis=1)
    lower = np.stack([edges[:, 1], low[:, 0], low[:, 1]], axis=1)
    faces = np.concatenate([mesh.faces, upper, lower]).astype(np.int32)
    return Mesh(np.concatenate([mesh.vertices, foot]), faces)


def _open_edges(mesh: Mesh) -> NDArray[np.int64]:
    """[E, 2] the directed edges that one face alone has."""
    directed = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    key = np.sort(directed, axis=1) @ np.array([len(mesh.vertices), 1])
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    return directed[first[count == 1]]
