"""The lens of the simulated colour camera: a wider pinhole picture, and the lookup that bends it."""

import math

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.errors import CaptureError
from schemas.job.views import Distortion
from schemas.scene.view import Intrinsics
from workers.geometry.distortion import undistort
from workers.geometry.jit import compiled

MARGIN_PX = 2
"""Width of the wider picture beyond what the lens sees, for samples beside a pixel's centre."""

WIDEST = 2.0
"""A pinhole picture that must be more than so many times as wide or high belongs to no lens of this camera."""


def opencv_lens(lens: Distortion | None) -> Array:
    """[8] float64: OpenCV's order k1, k2, p1, p2, k3, k4, k5, k6; all 0 without a lens."""
    if lens is None:
        return frozen_array(np.zeros(8))
    return frozen_array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, 0.0, 0.0, 0.0])


def pinhole_lookup(lens: Distortion, k: Intrinsics) -> tuple[Intrinsics, Array, Array]:
    """(a pinhole camera that sees all that the lens does, u [H, W] and v [H, W] in its image of each stored pixel's centre).

    Raises CaptureError where the lens folds over within the image, or needs a picture more than `WIDEST` times as large.
    """
    rows, columns = np.mgrid[0 : k.height, 0 : k.width]
    u, v = undistort(columns + 0.5, rows + 0.5, lens, k)
    if not (np.isfinite(u).all() and np.isfinite(v).all()):
        raise CaptureError("lens", f"the lens {lens} folds over within the image: make its coefficients smaller")
    left, top = math.floor(u.min()) - MARGIN_PX, math.floor(v.min()) - MARGIN_PX
    right, bottom = math.ceil(u.max()) + MARGIN_PX, math.ceil(v.max()) + MARGIN_PX
    if right - left > WIDEST * k.width or bottom - top > WIDEST * k.height:
        size = f"{right - left} x {bottom - top}"
        raise CaptureError("lens", f"the lens {lens} needs a pinhole picture of {size}: make its coefficients smaller")
    update = {"width": right - left, "height": bottom - top, "cx": k.cx - left, "cy": k.cy - top}
    return k.model_copy(update=update), u - left, v - top


def nearest_pixels(image: NDArray[np.generic], u: Array, v: Array) -> NDArray:
    """[H, W]: the value of `image` [h, w] in the pixel that each place lies in."""
    return image[np.floor(v).astype(np.int64), np.floor(u).astype(np.int64)]


@compiled
def add_bent_light(
    total: Array,
    rgb: NDArray[np.uint8],
    light_of: Array,
    lookup: tuple[Array, Array],
    offsets: tuple[float, float, float, float],
) -> None:
    """Adds linear light of a pinhole picture rgb [h, w, 3] seen through the lens to total [H, W, 3], in place.

    `lookup` is (u, v) of each stored pixel's centre. offsets: (right, down) of the sample from there in the stored image, by
    which the place moves with the lookup's slope, and (right, down) of the point that the picture has at its pixel centres.
    """
    u, v = lookup
    right, down, drawn_right, drawn_down = offsets
    height, width = total.shape[:2]
    for row in range(height):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        for column in range(width):
            before, after = max(column - 1, 0), min(column + 1, width - 1)
            along, across = right / max(after - before, 1), down / max(below - above, 1)
            x = u[row, column] - drawn_right - 0.5
            x += along * (u[row, after] - u[row, before]) + across * (u[below, column] - u[above, column])
            y = v[row, column] - drawn_down - 0.5
            y += along * (v[row, after] - v[row, before]) + across * (v[below, column] - v[above, column])
            i, j = int(y), int(x)
            a, b = x - j, y - i
            for channel in range(3):
                p, q = light_of[rgb[i, j, channel]], light_of[rgb[i, j + 1, channel]]
                r, s = light_of[rgb[i + 1, j, channel]], light_of[rgb[i + 1, j + 1, channel]]
                upper, lower = p + a * (q - p), r + a * (s - r)
                total[row, column, channel] += upper + b * (lower - upper)
