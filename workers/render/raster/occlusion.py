"""Ambient occlusion: the share of the sky seen from a level on which things stand. Pure functions.

On a square grid, things are columns from `under` to `top` above the level. Seen from a point, in one horizontal direction,
columns hide the sky between two elevation angles a < b, a share sin^2 b - sin^2 a of the cosine-weighted sky (integral of
2 sin cos). Sky visibility is the mean, over directions, of the remaining share.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from workers.geometry.jit import compiled

DIRECTIONS = 8
REACHES = (1.0, 2.0, 3.5, 5.5, 8.5, 12.5, 18.0)
"""Distances of the sampled columns, in steps of the grid."""


def sky_visibility(
    top: NDArray[np.float32], under: NDArray[np.float32], base: NDArray[np.float32], step_m: float
) -> NDArray[np.float32]:
    """[N, N] in [0, 1]: share of the sky seen from points `base` [N, N] metres above the level.

    top, under [N, N] metres above the level, both 0 where there is nothing, as around the grid.
    """
    return _sky_visibility(top, under, base, _offsets(), np.float32(step_m * step_m))


@cache
def _offsets() -> NDArray[np.int64]:
    """[DIRECTIONS, len(REACHES), 2]: steps (dx, dy) of the grid to the sampled columns."""
    angles = [2.0 * math.pi * (turn + 0.5) / DIRECTIONS for turn in range(DIRECTIONS)]
    offsets = [[(round(r * math.cos(a)), round(r * math.sin(a))) for r in REACHES] for a in angles]
    return np.array(offsets)


@compiled
def _sky_visibility(
    top: NDArray[np.float32],
    under: NDArray[np.float32],
    base: NDArray[np.float32],
    offsets: NDArray[np.int64],
    step2: np.float32,
) -> NDArray[np.float32]:
    size = len(top)
    one, zero = np.float32(1.0), np.float32(0.0)
    sky = np.empty_like(top)
    for y in range(size):
        for x in range(size):
            hidden = zero
            for turn in range(offsets.shape[0]):
                high, low = zero, one
                for reach in range(offsets.shape[1]):
                    dx, dy = offsets[turn, reach, 0], offsets[turn, reach, 1]
                    if not (0 <= x + dx < size and 0 <= y + dy < size):
                        break
                    rise = top[y + dy, x + dx] - base[y, x]
                    if rise <= zero:
                        continue
                    square = np.float32(dx * dx + dy * dy) * step2
                    foot = max(under[y + dy, x + dx] - base[y, x], zero)
                    high = max(high, rise * rise / (rise * rise + square))
                    low = min(low, foot * foot / (foot * foot + square))
                hidden += max(high - low, zero)
            sky[y, x] = one - hidden / np.float32(offsets.shape[0])
    return sky
