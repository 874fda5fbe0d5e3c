"""Alpha: the share of each pixel that a scene without ground covers, of the same faces as its mask. Pure."""

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
    alpha = np.zeros(region.shape, np.uint8)
    u, v = project(triangles.mesh.vertices, triangles.intrinsics)
    (top, bottom), (left, right) = (
        np.clip([np.floor(at.min()) - 1.0, np.ceil(at.max()) + 1.0], 0.0, most).astype(int)
        for at, most in zip((v, u), region.shape, strict=True)
    )
    if top >= bottom or left >= right:
        return alpha
    part = slice(top, bottom), slice(left, right)
    inner, shown, covered = is_inner(region)[part], region[part] > 0, np.zeros((bottom - top, right - left), np.uint64)
    # Of a closed body the faces that look away cover nothing but what the others do.
    seen = ~triangles.closed | (triangles.planes[1] < 0.0)
    faces = np.ascontiguousarray(triangles.mesh.faces[seen])
    open_from = _next_open(np.ascontiguousarray(inner).view(np.uint8))
    _cover(np.stack([u - left, v - top], axis=1), faces, open_from, _OFFSETS, covered)
    share = _SHARES[np.bitwise_count(covered)]
    share = np.where(shown, np.maximum(share, np.uint8(1)), np.minimum(share, np.uint8(254)))
    share[inner] = 255
    alpha[part] = share
    return alpha


def with_alpha(rgb: NDArray[np.uint8], region: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W, 4]: colour with straight alpha. A pixel whose centre shows nothing has the colour of the nearest that does."""
    image = np.zeros((*alpha.shape, 4), np.uint8)
    rows, columns = (np.flatnonzero(alpha.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return image
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    shown, there = region[part] > 0, alpha[part] > 0
    colours = cv2.cvtColor(np.ascontiguousarray(rgb[part]), cv2.COLOR_RGB2RGBA).view(np.uint32)[:, :, 0]
    if (beside := there & ~shown).any() and shown.any():
        # Every pixel that shows something has a number of its own.
        _, nearest = cv2.distanceTransformWithLabels(
            (~shown).view(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )
        colour_of = np.zeros(int(nearest.max()) + 1, np.uint32)
        colour_of[nearest[shown]] = colours[shown]
        colours[beside] = colour_of[nearest[beside]]
    colours[~there] = 0
    image[part] = colours.view(np.uint8).reshape(*there.shape, 4)
    image[:, :, 3] = alpha
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
        # From the highest corner in the image to the lowest: an edge is then the same for both faces that share it.
        a, b, c = faces[number, 0], faces[number, 1], faces[number, 2]
        if uv[b, 1] < uv[a, 1]:
            a, b = b, a
        if uv[c, 1] < uv[b, 1]:
            b, c = c, b
            if uv[b, 1] < uv[a, 1]:
                a, b = b, a
        low, middle, high = uv[a, 1], uv[b, 1], uv[c, 1]
        left, right = min(uv[a, 0], uv[b, 0], uv[c, 0]), max(uv[a, 0], uv[b, 0], uv[c, 0])
        if not (low < height and high > 0.0 and left < width and right > 0.0):
            continue
        whole = (uv[c, 0] - uv[a, 0]) / (high - low) if high > low else 0.0
        upper = (uv[b, 0] - uv[a, 0]) / (middle - low) if middle > low else 0.0
        lower = (uv[c, 0] - uv[b, 0]) / (high - middle) if high > middle else 0.0
        first, last = max(int(np.ceil(low * lines - 0.5)), 0), min(int(np.ceil(high * lines - 0.5)), height * lines)
        for row in range(first // lines, (last + lines - 1) // lines):
            if following[row, max(int(left), 0)] > right:
                continue
            for line in range(max(first, row * lines), min(last, (row + 1) * lines)):
                k, y = line - row * lines, (line + 0.5) / lines
                begin = uv[a, 0] + (y - low) * whole
                end = uv[a, 0] + (y - low) * upper if y < middle else uv[b, 0] + (y - middle) * lower
                if begin > end:
                    begin, end = end, begin
                column = following[row, min(max(int(np.ceil(max(begin, 0.0) - offsets[k])), 0), width)]
                while column < width and column + offsets[k] < end:
                    covered[row, column] |= np.uint64(1) << np.uint64(k)
                    column = following[row, column + 1]
