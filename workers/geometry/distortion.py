"""Lens distortion by OpenCV's model, Brown-Conrady with k1, k2, p1, p2 and k3."""

import numpy as np

from schemas.base import Array
from schemas.job.views import Distortion
from schemas.scene.view import Intrinsics

STEPS = 20
"""Steps of Newton's method; a lens that can be inverted needs fewer than ten."""

CONVERGED = 1e-9
"""Largest error, in focal lengths, of a point that counts as found: a millionth of a pixel."""


def distort(u: Array, v: Array, lens: Distortion, k: Intrinsics) -> tuple[Array, Array]:
    """Distorted image coordinates of the pinhole coordinates (u, v), pixels from the left and upper edge."""
    x, y = distort_rays((u - k.cx) / k.fx, (v - k.cy) / k.fy, lens)
    return k.fx * x + k.cx, k.fy * y + k.cy


def undistort(u: Array, v: Array, lens: Distortion, k: Intrinsics) -> tuple[Array, Array]:
    """The inverse of `distort`: pinhole coordinates of the distorted (u, v); nan where the lens maps nothing to.

    Newton's method from the point itself with the analytic Jacobian converges to rounding; OpenCV's default stops after
    five steps of a fixed-point iteration.
    """
    goal_x, goal_y = (u - k.cx) / k.fx, (v - k.cy) / k.fy
    x, y = goal_x.copy(), goal_y.copy()
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(STEPS):
            at_x, at_y = distort_rays(x, y, lens)
            (xx, xy), (yx, yy) = _jacobian(x, y, lens)
            miss_x, miss_y = goal_x - at_x, goal_y - at_y
            area = xx * yy - xy * yx
            x = x + (yy * miss_x - xy * miss_y) / area
            y = y + (xx * miss_y - yx * miss_x) / area
        at_x, at_y = distort_rays(x, y, lens)
        # A lens that folds over maps two points to one place: beyond the fold the Jacobian's determinant is negative.
        (xx, xy), (yx, yy) = _jacobian(x, y, lens)
        found = (np.hypot(goal_x - at_x, goal_y - at_y) < CONVERGED) & (xx * yy - xy * yx > 0.0)
    return np.where(found, k.fx * x + k.cx, np.nan), np.where(found, k.fy * y + k.cy, np.nan)


def distort_rays(x: Array, y: Array, lens: Distortion) -> tuple[Array, Array]:
    """Distorted coordinates at z = 1, by OpenCV's formula (calib3d, "Detailed Description")."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    return (
        x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r2 + 2.0 * x * x),
        y * radial + lens.p1 * (r2 + 2.0 * y * y) + 2.0 * lens.p2 * x * y,
    )


def _jacobian(x: Array, y: Array, lens: Distortion) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    slope = 2.0 * (lens.k1 + r2 * (2.0 * lens.k2 + r2 * 3.0 * lens.k3))  # d radial / d r2, times two
    across = x * y * slope + 2.0 * lens.p1 * x + 2.0 * lens.p2 * y
    return (
        (radial + x * x * slope + 2.0 * lens.p1 * y + 6.0 * lens.p2 * x, across),
        (across, radial + y * y * slope + 6.0 * lens.p1 * y + 2.0 * lens.p2 * x),
    )
