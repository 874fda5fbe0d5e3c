"""A small rasteriser in float64: depth of triangles at pixel centres, by a z-buffer."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.geometry.frames import invert, transform
from workers.geometry.jit import compiled


def draw_depth(mesh: Mesh, camera: Camera, near_m: float = 0.05) -> Array:
    """[H, W] float64: z of the nearest face at each pixel's centre, both sides of faces, 0 where there is none.

    Faces that reach nearer than `near_m` are left out.
    """
    k = camera.intrinsics
    depth = np.zeros((k.height, k.width))
    points = transform(invert(camera.T_world_cam), mesh.vertices)
    z = np.where(points[:, 2] > near_m, points[:, 2], np.nan)
    u, v = k.fx * points[:, 0] / z + k.cx - 0.5, k.fy * points[:, 1] / z + k.cy - 0.5
    _draw(u, v, 1.0 / z, mesh.faces, depth)
    return depth


@compiled
def _draw(u: Array, v: Array, q: Array, faces: NDArray[np.int32], depth: Array) -> None:
    height, width = depth.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if np.isnan(u[a]) or np.isnan(u[b]) or np.isnan(u[c]):
            continue
        area = (u[b] - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (v[b] - v[a])
        if area == 0.0:
            continue
        left = max(int(np.ceil(min(u[a], u[b], u[c]))), 0)
        right = min(int(np.floor(max(u[a], u[b], u[c]))), width - 1)
        top = max(int(np.ceil(min(v[a], v[b], v[c]))), 0)
        bottom = min(int(np.floor(max(v[a], v[b], v[c]))), height - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                wb = ((column - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (row - v[a])) / area
                wc = ((u[b] - u[a]) * (row - v[a]) - (column - u[a]) * (v[b] - v[a])) / area
                if wb < 0.0 or wc < 0.0 or wb + wc > 1.0:
                    continue
                z = 1.0 / (q[a] * (1.0 - wb - wc) + q[b] * wb + q[c] * wc)
                if depth[row, column] == 0.0 or z < depth[row, column]:
                    depth[row, column] = z
