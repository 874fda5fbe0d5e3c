"""Alpha: the share of each pixel that a scene without ground covers, of the same faces as its mask. Pure."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.camera import project, shown_part
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
    covered = np.zeros((bottom - top, right - left), np.uint64)
    # Of a closed body the faces that look away cover nothing but what the others do.
    seen = ~triangles.closed | (triangles.planes[1] < 0.0)
    faces = np.ascontiguousarray(triangles.mesh.faces[seen])
    open_from = _next_open(is_inner(region[part]).view(np.uint8))
    _cover(np.stack([u - left, v - top], axis=1), faces, open_from, _OFFSETS, covered)
    _write_shares(open_from, covered, _SHARES, region[part], alpha[part])
    return alpha


def with_alpha(rgb: NDArray[np.uint8], region: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W, 4]: colour with straight alpha. A pixel whose centre shows nothing has the colour of the nearest that does."""
    image = np.zeros((*alpha.shape, 4), np.uint8)
    part = shown_part(alpha)
    hidden = (region[part] == 0).view(np.uint8)
    if _join(rgb[part].copy(), hidden, alpha[part], image[part]) and not hidden.all():
        # Every pixel that shows something has a number of its own, from 1 on along rows.
        _, nearest = cv2.distanceTransformWithLabels(hidden, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
        beside = (hidden > 0) & (alpha[part] > 0)
        image[part][beside, :3] = rgb[part][hidden == 0][nearest[beside] - 1]
    return image


_BESIDE = np.array([(-1, 0), (0, -1), (1, 0), (0, 1), (-1, -1), (-1, 1), (1, 1), (1, -1)])
"""Rows and columns to the pixels beside one, the nearest first; of equally near ones in the order that OpenCV prefers them."""


@compiled_for("u1[:,:,::1], u1[:,::1], u1[:,:], u1[:,:,:]")
def _join(
    rgb: NDArray[np.uint8], hidden: NDArray[np.uint8], alpha: NDArray[np.uint8], image: NDArray[np.uint8]
) -> bool:
    """Writes colour and alpha into image [H, W, 4]; whether a hidden pixel kept its own, having none beside that is not."""
    height, width = hidden.shape
    kept = False
    for row in range(height):
        for column in range(width):
            if not alpha[row, column]:
                continue
            y, x, turn = row, column, 0
            while hidden[y, x] and turn < len(_BESIDE):
                y, x = row + _BESIDE[turn, 0], column + _BESIDE[turn, 1]
                if not (0 <= y < height and 0 <= x < width):
                    y, x = row, column
                turn += 1
            if hidden[y, x]:
                y, x, kept = row, column, True
            for channel in range(3):
                image[row, column, channel] = rgb[y, x, channel]
            image[row, column, 3] = alpha[row, column]
    return kept


@compiled_for("u1[:,::1]")
def _next_open(inner: NDArray[np.uint8]) -> NDArray[np.int32]:
    """[H, W + 1]: the first column from here on whose pixel is not among its like; W where there is none."""
    height, width = inner.shape
    following = np.empty((height, width + 1), np.int32)
    for row in range(height):
        following[row, width] = open_from = width
        for column in range(width - 1, -1, -1):
            open_from = open_from if inner[row, column] else column
            following[row, column] = open_from
    return following


@compiled_for("f8[:,::1], const(i4[:,::1]), i4[:,::1], f8[::1], u8[:,::1]")
def _cover(
    uv: Array, faces: NDArray[np.int32], following: NDArray[np.int32], offsets: Array, covered: NDArray[np.uint64]
) -> None:
    """Sets, in each open pixel, the bits of the samples that a face covers; uv [V, 2]: image coordinates of the vertices."""
    height, width = covered.shape
    lines = len(offsets)
    begin, end, bits = np.empty(lines), np.empty(lines), np.uint64(1) << np.arange(lines).astype(np.uint64)
    for number in range(len(faces)):
        # From the highest corner in the image to the lowest: an edge is then the same for both faces that share it.
        a, b, c = faces[number, 0], faces[number, 1], faces[number, 2]
        if uv[b, 1] < uv[a, 1]:
            a, b = b, a
        if uv[c, 1] < uv[b, 1]:
            b, c = c, b
            if uv[b, 1] < uv[a, 1]:
                a, b = b, a
        low, middle, high, x, bend = uv[a, 1], uv[b, 1], uv[c, 1], uv[a, 0], uv[b, 0]
        left, right = min(x, bend, uv[c, 0]), max(x, bend, uv[c, 0])
        if not (low < height and high > 0.0 and left < width and right > 0.0):
            continue
        whole = (uv[c, 0] - x) / (high - low) if high > low else 0.0
        upper = (bend - x) / (middle - low) if middle > low else 0.0
        lower = (uv[c, 0] - bend) / (high - middle) if high > middle else 0.0
        first, last = max(int(np.ceil(low * lines - 0.5)), 0), min(int(np.ceil(high * lines - 0.5)), height * lines)
        for row in range(first // lines, (last + lines - 1) // lines):
            if following[row, max(int(left), 0)] > right:
                continue
            # Where the face is in this row, to a pixel.
            least, most = right, left
            for y in (max(low, row), min(high, row + 1.0), middle):
                if row <= y <= row + 1.0:
                    at = x + (y - low) * whole
                    other = x + (y - low) * upper if y < middle else bend + (y - middle) * lower
                    least, most = min(least, at, other), max(most, at, other)
            if following[row, max(int(least - 1.0), 0)] > most + 1.0:
                continue
            start, stop = max(first - row * lines, 0), min(last - row * lines, lines)
            least, most = np.float64(width), 0.0
            for n in range(stop - start):
                y = (row * lines + start + n + 0.5) / lines
                at = x + (y - low) * whole
                other = x + (y - low) * upper if y < middle else bend + (y - middle) * lower
                begin[n], end[n] = (other, at) if at > other else (at, other)
            for n in range(stop - start):
                least, most = min(least, begin[n]), max(most, end[n])
            column = following[row, max(int(least), 0)]
            while column < width and column < most:
                covers, here, offset, bit = np.uint64(0), np.float64(column), offsets[start:stop], bits[start:stop]
                for n in range(stop - start):
                    inside = (begin[n] - offset[n] <= here) & (here + offset[n] < end[n])
                    covers |= bit[n] if inside else np.uint64(0)
                covered[row, column] |= covers
                column = following[row, column + 1]


@compiled_for("i4[:,::1], u8[:,::1], u1[::1], const(u1[:,:]), u1[:,:]")
def _write_shares(
    following: NDArray[np.int32],
    covered: NDArray[np.uint64],
    shares: NDArray[np.uint8],
    region: NDArray[np.uint8],
    alpha: NDArray[np.uint8],
) -> None:
    """Writes the shares of open pixels, and 255 of all others, into alpha [H, W]."""
    for row in range(covered.shape[0]):
        for column in range(covered.shape[1]):
            share = np.uint8(255)
            if following[row, column] == column:
                bits, count = covered[row, column], 0
                while bits:
                    bits, count = bits & (bits - np.uint64(1)), count + 1
                share = max(shares[count], np.uint8(1)) if region[row, column] else min(shares[count], np.uint8(254))
            alpha[row, column] = share
