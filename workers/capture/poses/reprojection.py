"""Corners of markers against their images: residuals with exact derivatives, and a robust fit of one view's pose."""

from dataclasses import dataclass

import numpy as np

from schemas.base import Array, Pose
from workers.capture.poses.motion import cross_matrix, moved
from workers.geometry.frames import invert, transform

CAUCHY = 3.0
"""A residual of this many standard deviations has half the weight of a small one."""
MAX_ROUNDS = 30
SETTLED = 1e-8
"""A step of fewer metres and radians ends a fit."""
FAR = 1e6
"""Residual, pixels, of a point behind the camera."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose fitted to corners. residuals [K, 2] pixels, information [6, 6] at unit sigma, cost in squared pixels."""

    T_board_cam: Pose
    residuals: Array
    information: Array
    cost: float


def residuals_of(T_board_cam: Pose, board: Array, rays: Array, focal: Array) -> tuple[Array, Array]:
    """([K, 2] pixels of an ideal pinhole with focal lengths [2], [K, 2, 6] derivatives by a small motion of the camera).

    Corners `board` [K, 3] are seen along `rays` [K, 2]. A point behind the camera has the residual FAR, without derivative.
    """
    p = transform(invert(T_board_cam), board)
    ahead = p[:, 2] > 1e-6
    z = np.where(ahead, p[:, 2], 1.0)
    x, y = p[:, 0] / z, p[:, 1] / z
    residuals = np.where(ahead[:, None], focal * (np.stack([x, y], axis=1) - rays), FAR)
    by_point = derivative_of_projection(x, y, z, focal) * ahead[:, None, None]
    by_motion = np.concatenate([-by_point, by_point @ cross_matrix(p)], axis=2)  # p changes by -dt - dr x p
    return residuals, by_motion


def derivative_of_projection(x: Array, y: Array, z: Array, focal: Array) -> Array:
    """[K, 2, 3]: of pixels by points in camera axes, at the rays (x, y) and depths z."""
    zero = np.zeros_like(x)
    rows = [np.stack([1 / z, zero, -x / z], axis=1), np.stack([zero, 1 / z, -y / z], axis=1)]
    return np.stack(rows, axis=1) * focal[:, None]


def spread(residuals: Array, floor: float) -> float:
    """Standard deviation of one coordinate of residuals [K, 2], by the median of their absolute values; at least `floor`."""
    return max(floor, float(np.median(np.abs(residuals))) * 1.4826) if residuals.size else floor


def fit_pose(start: Pose, board: Array, rays: Array, focal: Array, floor_px: float) -> Fit:
    """The pose nearest to `start` of least robust reprojection error: Levenberg-Marquardt, Cauchy weights.

    The scale of the weights is the residuals' own spread, at least `floor_px`.
    """
    T, damping = start, 1e-6
    residuals, jacobian = residuals_of(T, board, rays, focal)
    scale = CAUCHY * spread(residuals, floor_px)
    cost = _cost(residuals, scale)
    for _ in range(MAX_ROUNDS):
        information, gradient = _normal_equations(residuals, jacobian, scale)
        step = np.asarray(
            np.linalg.solve(information + damping * np.diag(np.diag(information) + 1e-9), -gradient), np.float64
        )
        trial = moved(T, step)
        new_residuals, new_jacobian = residuals_of(trial, board, rays, focal)
        new_cost = _cost(new_residuals, scale)
        if not new_cost < cost:
            damping = max(damping, 1e-6) * 10
            if damping > 1e8 or float(np.abs(step).max()) < SETTLED:
                break
            continue
        settled = float(np.abs(step).max()) < SETTLED
        T, residuals, jacobian, damping = trial, new_residuals, new_jacobian, damping * 0.1
        scale = min(scale, CAUCHY * spread(residuals, floor_px))
        cost = _cost(residuals, scale)
        if settled:
            break
    return Fit(T, residuals, _normal_equations(residuals, jacobian, scale)[0], cost)


def _cost(residuals: Array, scale: float) -> float:
    """Sum of Cauchy's loss over corners, squared pixels."""
    squares = (residuals**2).sum(axis=1)
    return float((scale**2 * np.log1p(squares / scale**2)).sum())


def _normal_equations(residuals: Array, jacobian: Array, scale: float) -> tuple[Array, Array]:
    weights = 1.0 / (1.0 + (residuals**2).sum(axis=1) / scale**2)
    weighted = jacobian * weights[:, None, None]
    return np.einsum("kij,kil->jl", weighted, jacobian), np.einsum("kij,ki->j", weighted, residuals)
