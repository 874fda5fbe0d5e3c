"""Planes fitted to the neighbourhood of each depth pixel: less noise, the angle of incidence, and no flying pixels.

On a plane 1/z is linear in the image, so the fit is exact there. Registered depth is coarser than the colour image that
it fills, so the neighbourhood is sampled with a stride that grows with the focal length.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.view import Intrinsics
from workers.geometry.jit import compiled

REACH = 2
"""Samples to each side: 5 x 5."""

STRIDE_FOCAL_PX = 456.0
"""Focal length at which neighbouring samples are one pixel apart: two pixels at the Azure Kinect's 912, about a depth pixel."""

WIDE = 0.035
"""A sample that is farther from the middle one than this share of its depth belongs to another surface: a slope of 80 degrees
across the neighbourhood."""

GATE = 0.008
"""A sample that is farther from the first fit than this share of its depth, over the cosine of incidence, belongs to another
surface: 6 mm at 0.8 m, three times the noise of a depth pixel that has twice the noise of an Azure Kinect."""

LEAST_SHARE = 0.44
"""A pixel with fewer samples on its own surface, 11 of 25, is a speck or between two surfaces: it is left out."""


@dataclass(frozen=True, eq=False)
class FittedDepth:
    """A window of a depth image after the fit; its first pixel is the image's (`top`, `left`).

    inverse [h, w] float32: 1/z of the fitted plane, 1/m, 0 where there is none; facing [h, w] float32: the cosine of
    incidence times the length of the pixel's ray at z = 1, which turns a difference of z into a distance from the plane.
    """

    top: int
    left: int
    inverse: NDArray[np.float32]
    facing: NDArray[np.float32]


def fit_depth(
    depth_m: NDArray[np.float32], k: Intrinsics, max_edge_deg: float, window: tuple[int, int, int, int] | None = None
) -> FittedDepth:
    """The fit of depth [H, W] in a window (top, left, bottom, right), all of it by default."""
    top, left, bottom, right = window or (0, 0, *depth_m.shape)
    shape = (max(bottom - top, 0), max(right - left, 0))
    inverse, facing = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    stride = max(1, round(k.fx / STRIDE_FOCAL_PX))
    least_cos = math.cos(math.radians(max_edge_deg))
    _fit(depth_m, (k.fx, k.fy, k.cx, k.cy), stride, least_cos, (top, left), inverse, facing)
    return FittedDepth(top, left, inverse, facing)


@compiled
def _fit(
    depth_m: NDArray[np.float32],
    k: tuple[float, float, float, float],
    stride: int,
    least_cos: float,
    corner: tuple[int, int],
    inverse: NDArray[np.float32],
    facing: NDArray[np.float32],
) -> None:
    """Two fits of 1/z = a + b du + c dv: to the samples at about the pixel's depth, then to those near the first plane."""
    height, width = depth_m.shape
    side = 2 * REACH + 1
    least = int(np.ceil(LEAST_SHARE * side * side))
    q, at_x, at_y = np.empty(side * side), np.empty(side * side), np.empty(side * side)
    plane = np.empty(3)
    for at_row in range(inverse.shape[0]):
        row = at_row + corner[0]
        ray_y = (row + 0.5 - k[3]) / k[1]
        for at_column in range(inverse.shape[1]):
            column = at_column + corner[1]
            z0 = depth_m[row, column]
            if not z0 > 0.0:
                continue
            n = 0
            for i in range(-REACH, REACH + 1):
                y = row + i * stride
                for j in range(-REACH, REACH + 1):
                    x = column + j * stride
                    if 0 <= y < height and 0 <= x < width:
                        z = depth_m[y, x]
                        if z0 * (1.0 - WIDE) < z < z0 * (1.0 + WIDE):
                            q[n], at_x[n], at_y[n] = 1.0 / z, j, i
                            n += 1
            if n < least or not _solve(q, at_x, at_y, n, plane):
                continue
            ray_x = (column + 0.5 - k[2]) / k[0]
            ray = np.sqrt(1.0 + ray_x * ray_x + ray_y * ray_y)
            slope = _facing(plane, stride, k, ray_x, ray_y)
            # dz = z^2 dq, so a share of the depth is the same share of its inverse.
            gate = min(GATE * ray / slope, WIDE) * plane[0]
            kept = 0
            for i in range(n):
                if abs(q[i] - plane[0] - plane[1] * at_x[i] - plane[2] * at_y[i]) < gate:
                    q[kept], at_x[kept], at_y[kept] = q[i], at_x[i], at_y[i]
                    kept += 1
            if kept < least or not _solve(q, at_x, at_y, kept, plane):
                continue
            slope = _facing(plane, stride, k, ray_x, ray_y)
            if slope >= least_cos * ray and abs(1.0 / z0 - plane[0]) < gate:
                inverse[at_row, at_column] = plane[0]
                facing[at_row, at_column] = slope


@compiled
def _solve(q: Array, x: Array, y: Array, n: int, plane: Array) -> bool:
    """Least squares of q = plane . (1, x, y) by Cramer's rule about the means; False where the samples lie in a line."""
    mx = my = mq = 0.0
    for i in range(n):
        mx += x[i]
        my += y[i]
        mq += q[i]
    mx, my, mq = mx / n, my / n, mq / n
    cxx = cyy = cxy = cxq = cyq = 0.0
    for i in range(n):
        dx, dy, dq = x[i] - mx, y[i] - my, q[i] - mq
        cxx += dx * dx
        cyy += dy * dy
        cxy += dx * dy
        cxq += dx * dq
        cyq += dy * dq
    area = cxx * cyy - cxy * cxy
    if not area > 1e-9:
        return False
    plane[1] = (cxq * cyy - cyq * cxy) / area
    plane[2] = (cyq * cxx - cxq * cxy) / area
    plane[0] = mq - plane[1] * mx - plane[2] * my
    return bool(plane[0] > 0.0)


@compiled
def _facing(plane: Array, stride: int, k: tuple[float, float, float, float], ray_x: float, ray_y: float) -> float:
    """Cosine of incidence times the ray's length: the plane is A x + B y + C z = 1 in camera coordinates."""
    A, B = plane[1] / stride * k[0], plane[2] / stride * k[1]
    C = plane[0] - A * ray_x - B * ray_y
    return float(plane[0] / np.sqrt(A * A + B * B + C * C))
