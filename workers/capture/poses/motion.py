"""Small rigid motions: the exponential map, its logarithm, and matrices of cross products.

A pose is changed from the right, in camera axes: T_board_cam <- T_board_cam exp(motion), motion = (metres, radians).
"""

import math

import numpy as np

from schemas.base import Array, Pose
from workers.geometry.frames import angle_between, pose, rotation_about


def exponential(rotation_vector: Array) -> Array:
    """[3, 3] float64: the rotation about a vector [3] by its length in radians."""
    angle = float(np.linalg.norm(rotation_vector))
    if angle < 1e-12:
        return np.eye(3) + cross_matrix(rotation_vector)
    return rotation_about(rotation_vector / angle, angle)


def logarithm(R: Array) -> Array:
    """[3] float64: the rotation vector of a rotation [3, 3] by less than pi."""
    angle = angle_between(np.eye(3), R)
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return 0.5 * axis if angle < 1e-9 else axis * (0.5 * angle / math.sin(angle))


def cross_matrix(vectors: Array) -> Array:
    """[..., 3, 3] float64: the matrices v x of vectors [..., 3]."""
    x, y, z = np.moveaxis(np.asarray(vectors, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=-2)


def moved(T: Pose, motion: Array) -> Pose:
    """[4, 4] float64: T after a small motion [6] (metres, then radians) in its own axes, kept orthonormal."""
    R = T[:3, :3] @ exponential(motion[3:])
    U, _, V = np.linalg.svd(R)
    return pose(U @ V, T[:3, 3] + T[:3, :3] @ motion[:3])
