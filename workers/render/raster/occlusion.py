"""Ambient occlusion: columns of things on a grid, and the share of the sky seen from the level below them. Pure functions.

On a square grid, things are columns from `under` to `top` above the level. Seen from a point, in one horizontal direction,
columns hide the sky between two elevation angles a < b, a share sin^2 b - sin^2 a of the cosine-weighted sky (integral of
2 sin cos). Sky visibility is the mean, over directions, of the remaining share.
"""

import math

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled

DIRECTIONS = 8
REACHES = (1.0, 2.0, 3.5, 5.5, 8.5, 12.5, 18.0)
"""Distances of the sampled columns, in steps of the grid."""

_ANGLES = [2.0 * math.pi * (turn + 0.5) / DIRECTIONS for turn in range(DIRECTIONS)]
OFFSETS = np.array([[(round(r * math.cos(a)), round(r * math.sin(a))) for r in REACHES] for a in _ANGLES])
"""[DIRECTIONS, len(REACHES), 2]: steps (dx, dy) of the grid to the sampled columns."""


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


@compiled
def sky_visibility(
    top: NDArray[np.float32], under: NDArray[np.float32], base: NDArray[np.float32], step_m: float
) -> NDArray[np.float32]:
    """[N, N] in [0, 1]: share of the sky seen from points `base` [N, N] metres above the level.

    top, under [N, N] metres above the level, both 0 where there is nothing, as around the grid.
    """
    size, step2 = len(top), np.float32(step_m * step_m)
    one, zero = np.float32(1.0), np.float32(0.0)
    sky = np.empty_like(top)
    hidden, high, low = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    for y in range(size):  # a row at a time, so that the loops over it are vectorised
        here, shown = base[y], sky[y]
        hidden[:] = zero
        for turn in range(OFFSETS.shape[0]):
            high[:], low[:] = zero, one
            for reach in range(OFFSETS.shape[1]):
                dx, dy = OFFSETS[turn, reach, 0], OFFSETS[turn, reach, 1]
                if not 0 <= y + dy < size:
                    break
                first, count = max(-dx, 0), size - abs(dx)
                tops, unders = top[y + dy, first + dx :], under[y + dy, first + dx :]
                bases, highs, lows = here[first:], high[first:], low[first:]
                square = np.float32(dx * dx + dy * dy) * step2
                for x in range(count):
                    rise, foot = tops[x] - bases[x], max(unders[x] - bases[x], zero)
                    to_top, to_foot = rise * rise / (rise * rise + square), foot * foot / (foot * foot + square)
                    highs[x] = max(highs[x], to_top) if rise > zero else highs[x]
                    lows[x] = min(lows[x], to_foot) if rise > zero else lows[x]
            for x in range(size):
                hidden[x] += max(high[x] - low[x], zero)
        for x in range(size):
            shown[x] = one - hidden[x] / np.float32(OFFSETS.shape[0])
    return sky
