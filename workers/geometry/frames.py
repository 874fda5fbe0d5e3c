"""Rigid transforms and rotations. World: z up, metres, floor at z = 0. Optical frame: x right, y down, z forward."""

import functools
import math
import operator
from collections.abc import Iterable

import numpy as np

from schemas.base import Array, Pose

UP, DOWN = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
"""The world's up, the floor's normal, and its down."""

_IDENTITY = np.eye(4)
"""To be copied: `numpy.eye` takes six times as long."""


def pose(rotation: Array, position: Array) -> Pose:
    """[4, 4] float64 from a [3, 3] rotation and a [3] position."""
    T = _IDENTITY.copy()
    T[:3, :3] = rotation
    T[:3, 3] = position
    return T


def translation(x: float, y: float, z: float) -> Pose:
    """[4, 4] float64: the transform without rotation."""
    T = _IDENTITY.copy()
    T[:3, 3] = x, y, z
    return T


def rotation_about(axis: Array, angle_rad: float) -> Array:
    """[3, 3] float64: right-handed rotation about a unit axis (Rodrigues' formula)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle_rad) * K + (1.0 - math.cos(angle_rad)) * (K @ K)


def half_turn(axis: Array) -> Array:
    """[3, 3] float64: the rotation by pi about a unit axis, 2 a a^T - I, exact where sin(pi) is not."""
    return 2.0 * np.outer(axis, axis) - np.eye(3)


def invert(T: Pose) -> Pose:
    """[4, 4] float64: the inverse of a rigid transform."""
    R = T[:3, :3].T
    return pose(R, -R @ T[:3, 3])


def transform(T: Pose, points: Array) -> Array:
    """[N, 3] float64: points after a rigid transform.

    Written out as sums of products, because a matrix product may add in another order on another machine.
    """
    x, y, z = np.ascontiguousarray(points.T)  # columns that lie apart take three times as long
    moved = np.empty((len(points), 3))
    for i in range(3):
        moved[:, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3]
    return moved


def cross(a: Array, b: Array) -> Array:
    """[3] float64: the cross product of two vectors [3], for which `np.cross` takes forty times as long."""
    (u, v, w), (x, y, z) = a.tolist(), b.tolist()
    return np.array([v * z - w * y, w * x - u * z, u * y - v * x])


def rotation_from_quaternion(xyzw: Array) -> Array:
    """[3, 3] float64 from a quaternion (x, y, z, w) of any length but zero."""
    x, y, z, w = np.asarray(xyzw, dtype=np.float64) / math.sqrt(add_up(float(c) ** 2 for c in xyzw))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def uniform_rotation(rng: np.random.Generator) -> Array:
    """[3, 3] float64: uniform over all rotations (a normal 4-vector has a uniform direction)."""
    return rotation_from_quaternion(rng.standard_normal(4))


def rotation_between(a: Array, b: Array) -> Array:
    """[3, 3] float64: the smallest rotation that takes unit vector a to unit vector b.

    For b = -a, where every axis normal to a would do, the axis is normal to a and to x (or to y, for a along x).
    """
    axis = cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-15:
        if cosine > 0:
            return np.eye(3)
        other = np.array([1.0, 0.0, 0.0]) if abs(a[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
        across = cross(a, other)
        return half_turn(across / np.linalg.norm(across))
    return rotation_about(axis / sine, math.atan2(sine, cosine))


def angle_between(A: Array, B: Array) -> float:
    """Angle, radians in [0, pi], between two rotations [3, 3]; accurate for tiny angles too."""
    D = A.T @ B
    sine = 0.5 * np.linalg.norm([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    return math.atan2(float(sine), 0.5 * (float(np.trace(D)) - 1.0))


def motion_between(points: Array, before: Array, after: Array) -> tuple[float, float]:
    """(largest travel of a body's points [N, 3], metres; rotation, radians) between two poses [4, 4] of the body."""
    travel = transform(after, points) - transform(before, points)
    return float(np.linalg.norm(travel, axis=1).max()), angle_between(before[:3, :3], after[:3, :3])


def quaternion_from_rotation(R: Array) -> Array:
    """(x, y, z, w) of a rotation [3, 3], by the largest of the four components (Shepperd 1978)."""
    trace = float(np.trace(R))
    squares = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    k = int(np.argmax(squares))
    q = np.empty(4)
    if k == 3:
        q[:] = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace]
    else:
        i, j, m = k, (k + 1) % 3, (k + 2) % 3
        q[i] = 1.0 + 2.0 * R[i, i] - trace
        q[j], q[m], q[3] = R[i, j] + R[j, i], R[i, m] + R[m, i], R[m, j] - R[j, m]
    return q / np.linalg.norm(q)


def add_up(numbers: Iterable[float]) -> float:
    """The sum of numbers, rounded at every term as by Python 3.11; since 3.12 `sum` carries what a term of floats loses."""
    return functools.reduce(operator.add, numbers, 0.0)
