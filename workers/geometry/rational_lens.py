"""A camera with OpenCV's rational lens: rays of its pixels, and pixels of points.

The formulas are those of OpenCV's documentation (calib3d, "Detailed Description"), which are Brown-Conrady's with a radial
factor (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6). A lens is [8] float64 in OpenCV's order: k1, k2, p1, p2,
k3, k4, k5, k6.
"""

import math

import numpy as np

from schemas.base import Array
from schemas.scene.view import Intrinsics
from workers.geometry.jit import compiled

WIDEST = 5.0
"""Largest distance from the axis at z = 1 that a lens is used at: 79 degrees."""

STEPS = 50
"""Most steps of Newton's method; a wide lens needs some ten at the corners of its image."""

CONVERGED = 1e-12
"""Largest error, in focal lengths, of a ray that counts as found."""


def usable_radius(lens: Array) -> float:
    """Distance from the axis at z = 1 up to which the lens maps larger radii to larger ones; at most `WIDEST`."""
    k1, k2, _, _, k3, k4, k5, k6 = lens
    r = np.linspace(0.0, WIDEST, 5001)
    r2 = r * r
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    with np.errstate(divide="ignore", invalid="ignore"):
        image = r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    falls = np.flatnonzero(~(np.diff(image) > 0.0) | ~(below[1:] > 0.0))
    return float(r[falls[0]]) if len(falls) else WIDEST


def pixel_rays(k: Intrinsics, lens: Array) -> Array:
    """[height, width, 2] float64: x / z and y / z of the ray through each pixel's centre; nan where the lens has none."""
    focal = (k.fx, k.fy, k.cx, k.cy)
    return _pixel_rays(k.height, k.width, focal, np.asarray(lens, np.float64), usable_radius(lens))


def project_points(points: Array, k: Intrinsics, lens: Array) -> Array:
    """[N, 2] float64: image coordinates, pixels from the left and upper edge, of points [N, 3] in the camera's frame.

    nan for points behind the camera and beyond the angle that the lens is used at.
    """
    return _project_points(points, (k.fx, k.fy, k.cx, k.cy), np.asarray(lens, np.float64), usable_radius(lens))


@compiled
def _distort(x: float, y: float, lens: Array) -> tuple[float, float, float, float, float, float]:
    """Distorted (x, y), and the derivatives dx/dx, dx/dy = dy/dx, dy/dy; last the square of the radius."""
    p1, p2 = lens[2], lens[3]
    r2 = x * x + y * y
    above = 1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
    below = 1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[7]))
    radial = above / below
    above_slope = lens[0] + r2 * (2.0 * lens[1] + 3.0 * r2 * lens[4])
    below_slope = lens[5] + r2 * (2.0 * lens[6] + 3.0 * r2 * lens[7])
    slope = 2.0 * (above_slope - radial * below_slope) / below  # d radial / d r2, times two
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        r2,
    )


@compiled
def _pixel_rays(height: int, width: int, focal: tuple[float, float, float, float], lens: Array, radius: float) -> Array:
    fx, fy, cx, cy = focal
    rays = np.full((height, width, 2), np.nan)
    for i in range(height):
        goal_y = (i + 0.5 - cy) / fy
        for j in range(width):
            goal_x = (j + 0.5 - cx) / fx
            x, y = goal_x, goal_y
            for _ in range(STEPS):
                at_x, at_y, xx, xy, yy, r2 = _distort(x, y, lens)
                miss_x, miss_y = goal_x - at_x, goal_y - at_y
                if abs(miss_x) < CONVERGED and abs(miss_y) < CONVERGED:
                    # A lens that folds over maps two rays to one place: only the one before the fold is meant.
                    if r2 <= radius * radius and xx * yy - xy * xy > 0.0:
                        rays[i, j, 0], rays[i, j, 1] = x, y
                    break
                area = xx * yy - xy * xy
                x += (yy * miss_x - xy * miss_y) / area
                y += (xx * miss_y - xy * miss_x) / area
                if not (math.isfinite(x) and math.isfinite(y)):
                    break
    return rays


@compiled
def _project_points(points: Array, focal: tuple[float, float, float, float], lens: Array, radius: float) -> Array:
    fx, fy, cx, cy = focal
    pixels = np.full((len(points), 2), np.nan)
    for n in range(len(points)):
        z = points[n, 2]
        if not z > 0.0:
            continue
        x, y, _, _, _, r2 = _distort(points[n, 0] / z, points[n, 1] / z, lens)
        if r2 <= radius * radius:
            pixels[n, 0], pixels[n, 1] = fx * x + cx, fy * y + cy
    return pixels
