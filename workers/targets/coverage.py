"""Alpha: the share of each pixel that a scene without ground covers, of the same faces as its mask. Pure."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.camera import project
from workers.geometry.jit import compiled_for
from workers.targets.surfaces import Triangles

SAMPLES = 64
"""Samples of a pixel, one on each of as many lines, at the columns of a Fibonacci lattice: a straight edge of any direction is
known to a hundredth of a pixel."""

_OFFSETS = np.modf((np.arange(SAMPLES) + 0.5) * 0.6180339887498949)[0]


def cover_pixels(triangles: Triangles, region: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] uint8: the share of each pixel that the faces cover, as 255; region [H, W] is the mask of the same view.

    Never 0 where the mask shows something, and never 255 where it does not: its sample is the pixel's centre. Among pixels that
    all show something no share is computed.
    """
    shown = (region > 0).astype(np.uint8)
    inner: NDArray = cv2.erode(shown, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    u, v = project(triangles.mesh.vertices, triangles.intrinsics)
    covered = np.zeros(region.shape, np.uint64)
    _cover(np.stack([u, v], axis=1), triangles.mesh.faces, _next_open(inner), _OFFSETS, covered)
    alpha = np.rint(np.bitwise_count(covered) * (255.0 / SAMPLES)).astype(np.uint8)
    alpha = np.where(shown > 0, np.maximum(alpha, 1), np.minimum(alpha, 254))
    return np.where(inner > 0, np.uint8(255), alpha).astype(np.uint8)


def with_alpha(rgb: NDArray[np.uint8], region: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W, 4]: colour with straight alpha. A pixel whose centre shows nothing has the colour of the nearest that does."""
    colour = rgb.copy()
    beside = (alpha > 0) & (region == 0)
    if beside.any() and (region > 0).any():
        _, nearest = cv2.distanceTransformWithLabels(
            (region == 0).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )
        shown = np.flatnonzero(region)
        at = np.zeros(int(nearest.max()) + 1, np.int64)
        at[nearest.reshape(-1)[shown]] = shown
        colour[beside] = rgb.reshape(-1, 3)[at[nearest[beside]]]
    colour[alpha == 0] = 0
    return np.dstack([colour, alpha])


@compiled_for("u1[:,::1]")
def _next_open(inner: NDArray[np.uint8]) -> NDArray[np.int32]:
    """[H, W + 1]: the first column from here on whose pixel is not among its like; W where there is none."""
    height, width = inner.shape
    following = np.full((height, width + 1), width, np.int32)
    for row in range(height):
        for column in range(width - 1, -1, -1):
            following[row, column] = following[row, column + 1] if inner[row, column] else column
    return following


@compiled_for("f8[:,::1], const(i4[:,::1]), i4[:,::1], f8[::1], u8[:,::1]")
def _cover(
    uv: Array, faces: NDArray[np.int32], following: NDArray[np.int32], offsets: Array, covered: NDArray[np.uint64]
) -> None:
    """Sets, in each open pixel, the bits of the samples that a face covers; uv [V, 2]: image coordinates of the vertices."""
    height, width = covered.shape
    lines = len(offsets)
    for number in range(len(faces)):
        a, b, c = faces[number, 0], faces[number, 1], faces[number, 2]
        low = min(uv[a, 1], uv[b, 1], uv[c, 1])
        high = max(uv[a, 1], uv[b, 1], uv[c, 1])
        if not (low < height and high > 0.0):
            continue
        left, right = min(uv[a, 0], uv[b, 0], uv[c, 0]), max(uv[a, 0], uv[b, 0], uv[c, 0])
        if not (left < width and right > 0.0):
            continue
        first, last = max(int(np.ceil(low * lines - 0.5)), 0), min(int(np.ceil(high * lines - 0.5)), height * lines)
        for line in range(first, last):
            row, k = line // lines, line % lines
            if following[row, max(int(left), 0)] > right:
                continue
            y, begin, end = (line + 0.5) / lines, np.inf, -np.inf
            for i, j in ((a, b), (b, c), (c, a)):
                if uv[i, 1] > uv[j, 1]:
                    i, j = j, i
                if uv[i, 1] <= y < uv[j, 1]:
                    x = uv[i, 0] + (y - uv[i, 1]) * ((uv[j, 0] - uv[i, 0]) / (uv[j, 1] - uv[i, 1]))
                    begin, end = min(begin, x), max(end, x)
            if begin >= end:
                continue
            begin, end = max(begin, 0.0), min(end, width + 1.0)
            column = following[row, min(max(int(np.ceil(begin - offsets[k])), 0), width)]
            while column < width and column + offsets[k] < end:
                covered[row, column] |= np.uint64(1) << np.uint64(k)
                column = following[row, column + 1]
