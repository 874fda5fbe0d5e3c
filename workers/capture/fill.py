"""Small holes of a synthesised view, filled from their rim."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled

STEP_M = 0.01
"""Depths that differ by more are of two surfaces; a pixel that both touch belongs to the farther one."""


def fill_holes(
    rgb: NDArray[np.uint8], depth_m: Array, mask: NDArray[np.bool_], size_px: int
) -> tuple[NDArray[np.uint8], Array, NDArray[np.bool_]]:
    """(rgb, depth_m, mask) where small holes are filled from their rims inwards, and outer edges stay as they are.

    Small are gaps of up to about 2 * size_px across, and holes that are enclosed and have at most (4 * size_px)^2 pixels.
    """
    if size_px == 0:
        return rgb, depth_m, mask
    holes = np.argwhere(_small_holes(depth_m > 0.0, size_px))
    rgb, depth_m, mask = rgb.copy(), depth_m.copy(), mask.copy()
    while len(holes):
        left = _fill_rim(rgb, depth_m, mask, holes)
        if left.all():
            break
        holes = holes[left]
    return rgb, depth_m, mask


def _small_holes(known: NDArray[np.bool_], size_px: int) -> NDArray[np.bool_]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size_px + 1, 2 * size_px + 1))
    # Beyond the image's edge nothing is known: without the border, closing would fill along it.
    border = 2 * size_px
    framed = np.pad(known.view(np.uint8), border)
    gaps = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, disc) > framed
    _, label, stats, _ = cv2.connectedComponentsWithStats(1 - framed, connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= (4 * size_px) ** 2
    small[0] = False
    return np.asarray((gaps | small[label])[border:-border, border:-border])


@compiled
def _fill_rim(
    rgb: NDArray[np.uint8], depth_m: Array, mask: NDArray[np.bool_], holes: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Fills the holes that have a known neighbour, all from what was known before; returns those that have none."""
    height, width = depth_m.shape
    left = np.ones(len(holes), np.bool_)
    found = np.zeros((len(holes), 5))
    for n in range(len(holes)):
        row, column = holes[n]
        farthest = 0.0
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                farthest = max(farthest, depth_m[y, x])
        if farthest == 0.0:
            continue
        count = 0
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                if depth_m[y, x] > farthest - STEP_M:
                    count += 1
                    found[n, 0] += depth_m[y, x]
                    found[n, 1] += mask[y, x]
                    for c in range(3):
                        found[n, 2 + c] += rgb[y, x, c]
        for i in range(5):
            found[n, i] /= count
        left[n] = False
    for n in range(len(holes)):
        if not left[n]:
            row, column = holes[n]
            depth_m[row, column] = found[n, 0]
            mask[row, column] = found[n, 1] > 0.5
            for c in range(3):
                rgb[row, column, c] = np.uint8(found[n, 2 + c] + 0.5)
    return left
