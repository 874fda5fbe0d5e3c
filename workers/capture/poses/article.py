"""The estimate `article`: corners lifted to 3-D by the depth image should lie on the board; BFGS on their distances.

Step (2) of the article, as it has it, with a robust loss and exact gradients. Depth is taken as it is.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from schemas.base import Array, Pose
from schemas.capture import CaptureEstimate, DepthCorrection, ViewEstimate
from workers.capture.poses.markers import cross_matrix, exponential, moved
from workers.capture.poses.observation import Corners
from workers.capture.poses.verdict import Evidence, Judged, judge

MIN_CORNERS = 4
SCALE_M = 0.02
"""Distance from which on a corner's loss grows linearly and no longer with the square: depth at an edge may be the floor's."""


@dataclass(frozen=True, eq=False)
class _Fitted:
    T_board_cam: Pose
    covariance: Array
    iterations: int
    converged: bool


def estimate_article(evidence: Evidence) -> CaptureEstimate:
    """Each view by itself, begun at its pose from markers."""
    views: list[ViewEstimate] = []
    most, converged = 0, True
    for observation, found in zip(evidence.observations, evidence.markers, strict=True):
        pose = Judged(None, faults=(found.reason,))
        if observation.manual_T_board_cam is not None:
            pose = Judged(observation.manual_T_board_cam, remarks=(observation.given_by,))
        elif found.fit is not None:
            fitted = fit_article(observation.corners, found.fit.T_board_cam, evidence.spec.max_iterations)
            lifted = int((observation.corners.depth_m > 0).sum())
            pose = Judged(None, faults=(f"{lifted} corners have depth, and {MIN_CORNERS} are needed",))
            if fitted is not None:
                pose = Judged(fitted.T_board_cam, fitted.covariance, by_corners=False)
                most, converged = max(most, fitted.iterations), converged and fitted.converged
        views.append(judge(observation, pose, evidence, DepthCorrection()))
    return CaptureEstimate("article", tuple(views), iterations=most, converged=converged)


def fit_article(corners: Corners, start: Pose, max_iterations: int = 100) -> _Fitted | None:
    """The pose of least robust distance between lifted corners and their places on the board; None without enough depth."""
    lifted = corners.depth_m > 0
    if lifted.sum() < MIN_CORNERS:
        return None
    z = corners.depth_m[lifted]
    points = np.column_stack([corners.rays[lifted] * z[:, None], z])
    board = corners.board[lifted]
    result = minimize(
        lambda motion: loss(motion, start, points, board),
        np.zeros(6),
        jac=True,
        method="BFGS",
        options={"maxiter": max_iterations, "gtol": 1e-7},
    )
    T = moved(start, result.x)
    # A line search that finds no further decrease has met the limit of float64: the gradient tells whether it is the end.
    converged = bool(result.success or np.abs(result.jac).max() < 1e-4)
    return _Fitted(T, _covariance(T, points, board), int(result.nit), converged)


def loss(motion: Array, start: Pose, points: Array, board: Array) -> tuple[float, Array]:
    """(mean of 2 (sqrt(1 + (d / scale)^2) - 1), its gradient [6]) after a motion (metres, radians) of `start`.

    d is the distance of a lifted corner (points [K, 3], camera axes) from its place (board [K, 3]). The gradient by the
    rotation vector goes through the right Jacobian of SO(3): exp(w + dw) = exp(w) exp(J(w) dw).
    """
    rotation = exponential(motion[3:])
    turned = points @ rotation.T
    R = start[:3, :3]
    difference = (turned + motion[:3]) @ R.T + start[:3, 3] - board
    squares = (difference**2).sum(axis=1) / SCALE_M**2
    root = np.sqrt(1.0 + squares)
    pull = (2.0 / SCALE_M**2) * difference / root[:, None] / len(points)  # derivative by the moved points, board axes
    in_camera = pull @ R
    by_turn = np.cross(points, in_camera @ rotation).sum(axis=0)
    gradient = np.concatenate([in_camera.sum(axis=0), right_jacobian(motion[3:]).T @ by_turn])
    return float((2.0 * (root - 1.0)).mean()), gradient


def right_jacobian(rotation_vector: Array) -> Array:
    """[3, 3]: J(w) of exp(w + dw) = exp(w) exp(J(w) dw) to first order (Chirikjian 2012, equation 10.86)."""
    angle = float(np.linalg.norm(rotation_vector))
    W = cross_matrix(rotation_vector)
    if angle < 1e-5:
        return np.eye(3) - 0.5 * W + W @ W / 6.0
    return np.eye(3) - (1 - math.cos(angle)) / angle**2 * W + (angle - math.sin(angle)) / angle**3 * (W @ W)


def _covariance(T: Pose, points: Array, board: Array) -> Array:
    """[6, 6] by the spread of the distances themselves; a bias that all corners share does not show in it."""
    difference = points @ T[:3, :3].T + T[:3, 3] - board
    jacobian = np.concatenate(
        [np.broadcast_to(T[:3, :3], (len(points), 3, 3)), -T[:3, :3] @ cross_matrix(points)], axis=2
    )
    free = max(1, difference.size - 6)
    information = np.einsum("kij,kil->jl", jacobian, jacobian)
    variance = float((difference**2).sum()) / free
    return np.asarray(variance * np.linalg.pinv(information, hermitian=True), np.float64)
