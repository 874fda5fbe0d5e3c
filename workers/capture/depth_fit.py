"""Planes fitted to the neighbourhood of each depth pixel: less noise, the angle of incidence, and no flying pixels.

On a plane 1/z is linear in the image, so the fit is exact there. Registered depth is coarser than the colour image that
it fills, so the neighbourhood is sampled with a stride that grows with the focal length.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.scene.camera import Intrinsics
from workers.geometry.jit import compiled

REACH = 2
"""Samples to each side: 5 x 5."""

STRIDE_FOCAL_PX = 456.0
"""Focal length at which neighbouring samples are one pixel apart: two pixels at the Azure Kinect's 912, about a depth pixel."""

GATE = 0.012
"""A sample that is farther from the middle one than this share of its depth belongs to another surface: ten times the noise
of a depth pixel, and a slope of 70 degrees across the neighbourhood."""

LEAST_SHARE = 0.6
"""A pixel with fewer samples of its own surface lies on an edge, where depth mixes two surfaces: it is left out."""


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
    """Least squares of 1/z = a + b du + c dv by Cramer's rule about the mean of the samples."""
    height, width = depth_m.shape
    least = int(np.ceil(LEAST_SHARE * (2 * REACH + 1) ** 2))
    for at_row in range(inverse.shape[0]):
        row = at_row + corner[0]
        ray_y = (row + 0.5 - k[3]) / k[1]
        for at_column in range(inverse.shape[1]):
            column = at_column + corner[1]
            z0 = depth_m[row, column]
            if not z0 > 0.0:
                continue
            low, high = z0 * (1.0 - GATE), z0 * (1.0 + GATE)
            n = 0
            sx = sy = sxx = sxy = syy = sq = sxq = syq = 0.0
            for i in range(-REACH, REACH + 1):
                y = row + i * stride
                if y < 0 or y >= height:
                    continue
                for j in range(-REACH, REACH + 1):
                    x = column + j * stride
                    if x < 0 or x >= width:
                        continue
                    z = depth_m[y, x]
                    if low < z < high:
                        q = 1.0 / z
                        n += 1
                        sx += j
                        sy += i
                        sxx += j * j
                        sxy += i * j
                        syy += i * i
                        sq += q
                        sxq += j * q
                        syq += i * q
            if n < least:
                continue
            mx, my, mq = sx / n, sy / n, sq / n
            cxx, cyy, cxy = sxx - sx * mx, syy - sy * my, sxy - sx * my
            cxq, cyq = sxq - sx * mq, syq - sy * mq
            area = cxx * cyy - cxy * cxy
            if not area > 0.0:
                continue
            b, c = (cxq * cyy - cyq * cxy) / area, (cyq * cxx - cxq * cxy) / area
            q = mq - b * mx - c * my
            ray_x = (column + 0.5 - k[2]) / k[0]
            A, B = b / stride * k[0], c / stride * k[1]
            C = q - A * ray_x - B * ray_y
            slope = q / np.sqrt(A * A + B * B + C * C)
            if q > 0.0 and slope >= least_cos * np.sqrt(1.0 + ray_x * ray_x + ray_y * ray_y):
                inverse[at_row, at_column] = q
                facing[at_row, at_column] = slope
