"""Lenses by OpenCV's model: Brown-Conrady with the radial factor (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6).

A lens is [8] float64 in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6. Image coordinates are pixels from the left and upper
edge: a pixel's centre is at +0.5 here, and at a whole number in OpenCV.
"""

import functools

import cv2
import numpy as np

from schemas.base import Array, frozen_array
from schemas.job.views import Distortion
from schemas.scene.view import Intrinsics
from workers.geometry.jit import compiled

WIDEST = 5.0
"""Largest distance from the axis at z = 1 that a lens is used at: 79 degrees."""

STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-11)
"""OpenCV inverts a lens by steps of a fixed-point iteration. These reach rounding, where its default of five does not."""

FOUND_PX = 1e-6
"""A pixel whose ray does not lead back to it as nearly as this has none: the lens folds over before it."""


def opencv_lens(lens: Distortion | None) -> Array:
    """[8] float64; all 0 without a lens."""
    if lens is None:
        return frozen_array(np.zeros(8))
    return frozen_array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, 0.0, 0.0, 0.0])


def opencv_matrix(k: Intrinsics) -> Array:
    """[3, 3] float64: the camera matrix as OpenCV has it, the first pixel's centre at 0."""
    return np.array([[k.fx, 0.0, k.cx_opencv], [0.0, k.fy, k.cy_opencv], [0.0, 0.0, 1.0]])


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


def project_points(points: Array, k: Intrinsics, lens: Array) -> Array:
    """[N, 2] float64: image coordinates of points [N, 3] in the camera's frame.

    nan for points behind the camera and beyond the angle that the lens is used at.
    """
    return _draw(points, (k.fx, k.fy, k.cx, k.cy), lens, usable_radius(lens))


def rays_of_pixels(pixels: Array, k: Intrinsics, lens: Array) -> Array:
    """[N, 2] float64: (x / z, y / z) of image coordinates [N, 2]; nan where the lens maps nothing to."""
    rays = (pixels - np.array([k.cx, k.cy])) / np.array([k.fx, k.fy])
    if not np.any(lens) or not len(rays):
        return rays
    found = cv2.undistortPoints((pixels - 0.5).reshape(-1, 1, 2), opencv_matrix(k), lens, criteria=STOP)
    rays = found.reshape(-1, 2).astype(np.float64)
    back = project_points(np.column_stack([rays, np.ones(len(rays))]), k, lens)
    with np.errstate(invalid="ignore"):
        good = np.abs(back - pixels).max(axis=1) <= FOUND_PX
    rays[~good] = np.nan
    return rays


def pixel_rays(k: Intrinsics, lens: Array) -> Array:
    """[height, width, 2] float64, read-only: (x / z, y / z) through each pixel's centre; nan where the lens has none."""
    return _pixel_rays(k, tuple(float(x) for x in lens))


@functools.lru_cache(maxsize=4)
def _pixel_rays(k: Intrinsics, lens: tuple[float, ...]) -> Array:
    """Kept, because it is the same for every view and takes longer than what is done with it."""
    rows, columns = np.mgrid[0 : k.height, 0 : k.width]
    centres = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
    return frozen_array(rays_of_pixels(centres, k, np.array(lens)).reshape(k.height, k.width, 2))


def distort(u: Array, v: Array, lens: Distortion, k: Intrinsics) -> tuple[Array, Array]:
    """Image coordinates through the lens of the pinhole coordinates (u, v), also where it folds over."""
    rays = np.stack([(u.ravel() - k.cx) / k.fx, (v.ravel() - k.cy) / k.fy, np.ones(u.size)], axis=1)
    x, y = _draw(rays, (k.fx, k.fy, k.cx, k.cy), opencv_lens(lens), np.inf).T
    return x.reshape(u.shape), y.reshape(v.shape)


def undistort(u: Array, v: Array, lens: Distortion, k: Intrinsics) -> tuple[Array, Array]:
    """The inverse of `distort`: pinhole coordinates of (u, v) through the lens; nan where the lens maps nothing to."""
    x, y = rays_of_pixels(np.stack([u.ravel(), v.ravel()], axis=1), k, opencv_lens(lens)).T
    return (k.fx * x + k.cx).reshape(u.shape), (k.fy * y + k.cy).reshape(v.shape)


@compiled
def _draw(points: Array, focal: tuple[float, float, float, float], lens: Array, radius: float) -> Array:
    """[N, 2]: image coordinates by OpenCV's formula (calib3d, "Detailed Description"), nan farther off the axis than `radius`."""
    fx, fy, cx, cy = focal
    p1, p2 = lens[2], lens[3]
    pixels = np.full((len(points), 2), np.nan)
    for n in range(len(points)):
        z = points[n, 2]
        if not z > 0.0:
            continue
        x, y = points[n, 0] / z, points[n, 1] / z
        r2 = x * x + y * y
        if r2 <= radius * radius:
            above = 1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
            radial = above / (1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[7])))
            pixels[n, 0] = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx
            pixels[n, 1] = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
    return pixels
