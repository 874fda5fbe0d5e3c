"""Alpha: the share of each pixel that a scene without ground covers, of the same faces as its mask. Pure."""

from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.camera import project
from workers.geometry.jit import compiled_for
from workers.geometry.pixels import is_inner
from workers.targets.surfaces import Triangles

SAMPLES = 64
"""Samples of a pixel, one on each of as many lines, at the columns of a Fibonacci lattice: a straight edge of any direction is
known to a hundredth of a pixel."""

_OFFSETS = np.modf((np.arange(SAMPLES) + 0.5) * 0.6180339887498949)[0]
_SHARES = np.rint(np.arange(SAMPLES + 1) * (255.0 / SAMPLES)).astype(np.uint8)


def cover_pixels(triangles: Triangles, region: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] uint8: the share of each pixel that the faces cover, as 255; region [H, W] is the mask of the same view.

    Never 0 where the mask shows something, and never 255 where it does not: its sample is the pixel's centre. A pixel that, with
    all eight beside it, shows something is covered; of no such pixel a share is computed.
    """
    inner = is_inner(region)
    u, v = project(triangles.mesh.vertices, triangles.intrinsics)
    covered = np.zeros(region.shape, np.uint64)
    _cover(np.stack([u, v], axis=1), triangles.mesh.faces, _next_open(inner.view(np.uint8)), _OFFSETS, covered)
    alpha = _SHARES[np.bitwise_count(covered)]
    alpha = np.where(region > 0, np.maximum(alpha, np.uint8(1)), np.minimum(alpha, np.uint8(254)))
    alpha[inner] = 255
    return alpha


def with_alpha(rgb: NDArray[np.uint8], region: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W, 4]: colour with straight alpha. A pixel whose centre shows nothing has the colour of the nearest that does."""
    image = cast(NDArray[np.uint8], cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA))
    image[:, :, 3] = alpha
    pixels = image.view(np.uint32)[:, :, 0]
    pixels[alpha == 0] = 0
    rows, columns = np.nonzero((alpha > 0) & (region == 0))
    if len(rows) and (region > 0).any():
        # Of the part about these pixels alone; every one that shows something has a number of its own there.
        part = slice(max(rows.min() - 2, 0), rows.max() + 3), slice(max(columns.min() - 2, 0), columns.max() + 3)
        shown, seen = region[part] > 0, pixels[part]
        if shown.any():
            _, nearest = cv2.distanceTransformWithLabels(
                (~shown).view(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
            )
            colours = np.zeros(int(nearest.max()) + 1, np.uint32)
            colours[nearest[shown]] = seen[shown]
            beside = rows - part[0].start, columns - part[1].start
            near = colours[nearest[beside]].view(np.uint8).reshape(-1, 4)
            image[rows, columns, :3] = near[:, :3]
    return image


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
        for row in range(first // lines, (last + lines - 1) // lines):
            if following[row, max(int(left), 0)] > right:
                continue
            for line in range(max(first, row * lines), min(last, (row + 1) * lines)):
                k, y, begin, end = line - row * lines, (line + 0.5) / lines, np.inf, -np.inf
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
