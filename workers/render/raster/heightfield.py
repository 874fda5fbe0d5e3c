"""Elevations of things above a level, on a square grid: pure functions."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled


def column_extents(
    vertices: Array, faces: NDArray[np.integer], low: Array, step_m: float, size: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(top, under), each [size, size] float32 metres above `low[2]`: highest and lowest elevation of the triangles.

    Sampled at the centres of cells of `step_m`, the first of which begins at `low` (x along columns, y along rows). Both are
    0 where nothing is, and points below the level count as on it. Vertices [V, 3] in metres, faces [F, 3].
    """
    top, under = np.zeros((size, size), np.float32), np.full((size, size), np.inf, np.float32)
    local = (vertices - low) / np.array([step_m, step_m, 1.0])
    _fill_columns(local[:, 0] - 0.5, local[:, 1] - 0.5, np.maximum(local[:, 2], 0.0), faces, top, under)
    return top, np.where(np.isinf(under), np.float32(0.0), under)


@compiled
def _fill_columns(
    x: Array, y: Array, z: Array, faces: NDArray[np.integer], top: NDArray[np.float32], under: NDArray[np.float32]
) -> None:
    """Interpolates z by barycentric coordinates at each grid point within a triangle's bounding box."""
    size = len(top)
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        area = (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])
        if area == 0.0:
            continue
        first = max(int(np.ceil(min(x[a], x[b], x[c]))), 0)
        last = min(int(np.floor(max(x[a], x[b], x[c]))), size - 1)
        for row in range(
            max(int(np.ceil(min(y[a], y[b], y[c]))), 0), min(int(np.floor(max(y[a], y[b], y[c]))), size - 1) + 1
        ):
            for column in range(first, last + 1):
                of_c = ((x[b] - x[a]) * (row - y[a]) - (column - x[a]) * (y[b] - y[a])) / area
                of_b = ((column - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (row - y[a])) / area
                if of_b >= 0.0 and of_c >= 0.0 and of_b + of_c <= 1.0:
                    elevation = np.float32(z[a] + of_b * (z[b] - z[a]) + of_c * (z[c] - z[a]))
                    top[row, column] = max(top[row, column], elevation)
                    under[row, column] = min(under[row, column], elevation)
