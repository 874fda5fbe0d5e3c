"""How open the sky is above a level on which things stand, from their heights: pure functions.

A thing is a column from `under` to `top` above the level, as seen from straight above and below on a square grid. From a
point, in one direction along the ground, columns hide the sky between two elevations a < b; of cosine-weighted sky,
between them lies sin^2 b - sin^2 a (integral of 2 sin cos). Openness is the mean over directions of what is left.
"""

import math

import numpy as np
from numpy.typing import NDArray

DIRECTIONS = 8
REACHES = (1.0, 2.0, 3.5, 5.5, 8.5, 12.5, 18.0)
"""Distances that are looked at, in steps of the grid."""

MARGIN = 19
"""Steps of the grid around it that are taken as empty."""


def openness(
    top: NDArray[np.float32], under: NDArray[np.float32], base: NDArray[np.float32], step_m: float
) -> NDArray[np.float32]:
    """[N, N] in [0, 1]: share of the sky seen from height `base` [N, N] above the level, looking up.

    top, under [N, N] metres above the level, both 0 where there is nothing.
    """
    size = len(top)
    wide_top, wide_under = (np.pad(image, MARGIN) for image in (top, under))
    hidden = np.zeros_like(top)
    for turn in range(DIRECTIONS):
        angle = 2.0 * math.pi * (turn + 0.5) / DIRECTIONS
        high, low = np.zeros_like(top), np.ones_like(top)
        for reach in REACHES:
            dx, dy = round(reach * math.cos(angle)), round(reach * math.sin(angle))
            square = np.float32((dx * dx + dy * dy) * step_m * step_m)
            window = np.s_[MARGIN + dy : MARGIN + dy + size, MARGIN + dx : MARGIN + dx + size]
            rise = np.maximum(wide_top[window] - base, 0.0) ** 2
            foot = np.maximum(wide_under[window] - base, 0.0) ** 2
            upper = rise / (rise + square)
            np.maximum(high, upper, out=high)
            np.minimum(low, np.where(upper > 0.0, foot / (foot + square), 1.0), out=low)
        hidden += np.maximum(high - low, 0.0)
    return (1.0 - hidden / DIRECTIONS).astype(np.float32)
