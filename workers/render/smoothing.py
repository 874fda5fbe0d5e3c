"""Anti-aliasing of colour: pure functions on images. Labels are never touched: they are the ones of the pixel's centre.

Two ways. `smooth` blends each pixel at an edge with what lies along that edge (after FXAA, Lottes 2009), a millisecond or
two an image. `blend` takes the mean, in linear light, with the same pixels drawn at three more points, which costs twice
what the image itself does.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.scene import REGION_FLOOR
from workers.render.batches import SRGB_STEPS, encode_srgb

CONTRAST = 24
"""Steps of 8 bits between a pixel and a neighbour from which on the pixel counts as an edge."""

RADIUS_PX = 0.38
OFFSETS_PX = tuple(
    (RADIUS_PX * math.cos(math.radians(a)), RADIUS_PX * math.sin(math.radians(a))) for a in (15, 135, 255)
)
"""Where the three lie about the centre: no two of the four share a row or a column, and their mean is the centre."""

SPAN_PX = 8.0
STRIP = 64
_SQUARE = np.ones((3, 3), np.uint8)

LINEAR_STEPS = 16_383
_LINEAR = np.rint(SRGB_STEPS * LINEAR_STEPS).astype(np.uint16)
_SRGB = np.rint(255.0 * encode_srgb(np.arange(LINEAR_STEPS + 1) / LINEAR_STEPS)).astype(np.uint8)


def edges(rgb: NDArray[np.uint8], region: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] uint8, 255 where a pixel's colour is more than `CONTRAST` from one beside it. rgb [H, W, 3].

    Not amid the floor (region [H, W]): what is seen there is its texture, which is smooth already.
    """
    spread = cv2.morphologyEx(rgb, cv2.MORPH_GRADIENT, _SQUARE)
    strong = cv2.bitwise_not(cv2.inRange(spread, (0, 0, 0), (CONTRAST,) * 3))
    things = cv2.dilate((region != REGION_FLOOR).astype(np.uint8), _SQUARE)
    return np.asarray(cv2.multiply(strong, things), np.uint8)


def smooth(rgb: NDArray[np.uint8], mask: NDArray[np.uint8]) -> None:
    """Blend `rgb` [H, W, 3] along its edges where the mask [H, W] says.

    The edge runs across the gradient of brightness over the four pixels' corners. Along it, two taps close by and two as
    far as the edge is flat, at most `SPAN_PX`: the farther ones count where they stay between the neighbours' brightness.
    """
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return
    padded = np.zeros(-(-len(rows) // STRIP) * STRIP, np.float32)
    x, y = padded.copy(), padded.copy()
    x[: len(rows)], y[: len(rows)] = columns, rows
    grey: NDArray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    lows, highs = cv2.erode(grey, _SQUARE), cv2.dilate(grey, _SQUARE)
    # Binomial differences across the pixel: exactly 0 and 1 for the directions of level and upright edges.
    along_x, along_y = (cv2.Sobel(grey, cv2.CV_32F, dx, dy)[rows, columns] for dx, dy in ((0, 1), (1, 0)))
    along_y = -along_y
    least = np.maximum(np.minimum(np.abs(along_x), np.abs(along_y)), 1.0)
    step_x, step_y = (np.clip(d / least, -SPAN_PX, SPAN_PX).astype(np.float32) for d in (along_x, along_y))
    length = np.maximum(np.hypot(along_x, along_y), 1.0)

    def taps(dx: NDArray, dy: NDArray) -> NDArray[np.float32]:
        total = np.zeros((len(rows), 3), np.float32)
        for sign in (-1.0, 1.0):
            u, v = x.copy(), y.copy()
            u[: len(rows)] += np.float32(sign) * dx
            v[: len(rows)] += np.float32(sign) * dy
            seen = cv2.remap(
                rgb, u.reshape(-1, STRIP), v.reshape(-1, STRIP), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
            )
            total += seen.reshape(-1, 3)[: len(rows)]
        return total

    near = taps(along_x / length * 0.5, along_y / length * 0.5) * np.float32(0.5)
    far = near * np.float32(0.5) + taps(step_x * 0.5, step_y * 0.5) * np.float32(0.25)
    level = far @ np.array([0.299, 0.587, 0.114], np.float32)
    fits = (level >= lows[rows, columns]) & (level <= highs[rows, columns])
    rgb[rows, columns] = np.rint(np.where(fits[:, None], far, near)).astype(np.uint8)


def blend(rgb: NDArray[np.uint8], others: Sequence[NDArray[np.uint8]], mask: NDArray[np.uint8]) -> None:
    """Put the mean, in linear light, of `rgb` [H, W, 3] and the others [H, W, 4] where the mask says, into `rgb`."""
    chosen = np.flatnonzero(mask)
    pixels = rgb.reshape(-1, 3)
    total = _LINEAR[pixels[chosen]].astype(np.uint32)
    for other in others:
        total += _LINEAR[other.reshape(-1, 4)[chosen, :3]]
    count = 1 + len(others)
    pixels[chosen] = _SRGB[(total + count // 2) // count]
