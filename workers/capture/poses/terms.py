"""Least squares over all views: small motions, the parameters that all views share, rows of residuals, and the least cost.

A pose is changed from the right, in camera axes: T_board_cam <- T_board_cam exp(motion), motion = (metres, radians).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from schemas.base import Array, Pose, frozen_array
from schemas.capture import DepthCorrection
from schemas.job.captures import Estimation
from workers.capture.poses.observation import Patches
from workers.geometry.frames import add_up, invert, pose

AXES = np.cross(np.eye(3), np.eye(3)[:, None]).reshape(3, 9)
"""The matrices e x of the three axes e: `np.cross` of many vectors takes ten times as long as one product with these."""


def cross_matrix(vectors: Array) -> Array:
    """[..., 3, 3] float64: the matrices v x of vectors [..., 3]."""
    return (np.asarray(vectors, np.float64) @ AXES).reshape(*vectors.shape, 3)


def moved(T: Array, motion: Array) -> Array:
    """[..., 4, 4] float64: poses T after small motions [..., 6] in their own axes, kept orthonormal."""
    R, after = T[..., :3, :3], T.copy()
    U, _, V = np.linalg.svd(R @ Rotation.from_rotvec(motion[..., 3:]).as_matrix())
    after[..., :3, :3] = U @ V
    after[..., :3, 3] += (R @ motion[..., :3, None])[..., 0]
    return after


def motion_between(T: Pose, other: Pose) -> Array:
    """[6]: the small motion (metres, then radians) in the axes of T that takes T to the other."""
    step = invert(T) @ other
    return np.concatenate([step[:3, 3], Rotation.from_matrix(step[:3, :3]).as_rotvec()])


NAMES = (
    *("offset_m", "scale", "shift_x_m", "shift_y_m", "shift_z_m", "turn_x_rad", "turn_y_rad", "turn_z_rad"),
    *("print_scale", "growth_m", "growth_px"),
)
"""The shared parameters in the order in which they stand in every array of S = 11 numbers.

A printed square may look larger than it is: by `growth_m` where ink spreads, by `growth_px` where the camera sharpens.
"""
DEPTH_SCALE = NAMES.index("scale")
PRINT_SCALE = NAMES.index("print_scale")
GROWTH_M, GROWTH_PX = NAMES.index("growth_m"), NAMES.index("growth_px")
POSE, SHARED = 6, len(NAMES)

OFFSET_M = 0.011
SCALE = 0.001
"""The Azure Kinect's systematic error is below 11 mm + 0.1 % of the distance (Microsoft, Azure Kinect DK hardware
specifications); taken as one sigma, because it is a bound for good conditions."""
SCALE_BY_PRINT = 0.5
"""Sigma of the scale of depth where the print is metric truth: the scale then takes up the error of the print as well."""
SHIFT_M = 0.010
TURN_RAD = math.radians(0.5)
"""Registration: users report up to 1 to 2 cm between markers and depth."""
PRINT = 0.5
"""Nothing is known of the print's size where depth is metric truth."""
GROW_M = 0.0005
"""Growth of a side: ink spreads by a few tenths of a millimetre."""
GROW_PX = 0.3
"""Sharpening, tone curves and noise reduction move an edge by up to a few tenths of a pixel."""
SIGNIFICANT = 3.0
"""Sigmas from which on a difference is told."""
IDENTIFIED = 0.5
"""A parameter is identified by a capture that leaves it less than this share of its prior sigma."""


@dataclass(frozen=True, eq=False)
class Shared:
    """Values of the shared parameters; those of a capture that knows nothing are the defaults."""

    offset_m: float = 0.0
    scale: float = 1.0
    T_cam_depth: Pose = field(default_factory=lambda: frozen_array(np.eye(4)))
    print_scale: float = 1.0
    growth_m: float = 0.0
    growth_px: float = 0.0

    def corrected(self, patches: Patches) -> Array:
        """[P, 3] metres, camera axes: the middles of patches after the correction."""
        raw = self.scale * patches.ray_z + self.offset_m * patches.ray
        return raw @ self.T_cam_depth[:3, :3].T + self.T_cam_depth[:3, 3]

    def derivative(self, patches: Patches) -> Array:
        """[P, 3, S]: of `corrected` by the parameters; those of registration are a shift and a turn of what is corrected."""
        R = self.T_cam_depth[:3, :3]
        turned = (self.scale * patches.ray_z + self.offset_m * patches.ray) @ R.T
        by = np.zeros((len(patches), 3, SHARED))
        by[:, :, 0] = patches.ray @ R.T
        by[:, :, 1] = patches.ray_z @ R.T
        by[:, :, 2:5] = np.eye(3)
        by[:, :, 5:8] = -cross_matrix(turned)
        return by

    def moved(self, step: Array) -> "Shared":
        """The parameters after a step [S]."""
        U, _, V = np.linalg.svd(Rotation.from_rotvec(step[5:8]).as_matrix() @ self.T_cam_depth[:3, :3])
        T = frozen_array(pose(U @ V, self.T_cam_depth[:3, 3] + step[2:5]))
        plain = np.array([self.offset_m, self.scale, self.print_scale, self.growth_m, self.growth_px])
        plain = plain + step[[0, 1, *range(8, SHARED)]]
        offset_m, scale, print_scale, growth_m, growth_px = plain.tolist()
        return Shared(offset_m, scale, T, print_scale, growth_m, growth_px)

    def deviation(self) -> Array:
        """[S]: how far each parameter is from its expected value."""
        turn = Rotation.from_matrix(self.T_cam_depth[:3, :3]).as_rotvec()
        parts = [self.offset_m, self.scale - 1, *self.T_cam_depth[:3, 3], *turn, self.print_scale - 1]
        return np.array([*parts, self.growth_m, self.growth_px], dtype=np.float64)


def prior_sigma(spec: Estimation, has_depth: bool) -> Array:
    """[S]: how far each parameter may be from its expected value, one sigma; 0 for those that are not estimated."""
    scale, print_ = (SCALE_BY_PRINT, 0.0) if spec.trust == "print" else (SCALE, PRINT)
    of_depth = np.array([OFFSET_M, scale, *[SHIFT_M] * 3, *[TURN_RAD] * 3, print_]) * has_depth
    return np.concatenate([of_depth, [GROW_M, GROW_PX]])


def correct_depth(shared: Shared, sigma: Array, prior: Array) -> DepthCorrection:
    """What the other stages need, with the parameters that the capture determines, by their sigma [S] after and before."""
    identified = tuple(n for n, after, before in zip(NAMES, sigma, prior, strict=True) if after < IDENTIFIED * before)
    return DepthCorrection(shared.offset_m, shared.scale, shared.T_cam_depth, identified)


@dataclass(frozen=True, eq=False)
class Rows:
    """N residuals in standard deviations, each of k views: one, or the two of a pair.

    view [N, k] indices; by_view [N, k, 6] derivatives by small motions of those views; by_shared [N, S]; weight [N]: robust
    weight over the inflation of the term's variance; cost: robust, of all rows.
    """

    residual: Array
    view: NDArray[np.int64]
    by_view: Array
    by_shared: Array
    weight: Array
    cost: float

    def of_view(self, number: int) -> tuple[Array, Array, Array]:
        """(J [n, 6], residual [n], by_shared [n, S]) of the rows of one view alone, times the roots of their weights."""
        chosen = (self.view[:, 0] == number) & (self.view[:, -1] == number)
        root = np.sqrt(self.weight[chosen])[:, None]
        return root * self.by_view[chosen, 0], root[:, 0] * self.residual[chosen], root * self.by_shared[chosen]


class Term(Protocol):
    """Fixed data of one kind, whose rows depend on the poses [V, 4, 4] (T_board_cam) and on the shared parameters.

    The sigma of depth grows with its scale: otherwise a smaller scale, which makes noise smaller, would always fit better.
    """

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """The residuals of all views."""


def normal_equations(terms: Sequence[Rows], views: int) -> tuple[Array, Array]:
    """(J^T W J [D, D], J^T W r [D]), D = 6 V + S, the shared parameters last."""
    size = POSE * views + SHARED
    whole = np.zeros((size + 1, size + 1))  # the residual is one column more
    for rows in terms:
        by_view = rows.by_view.reshape(len(rows.residual), -1)
        columns = np.column_stack([by_view, rows.by_shared, rows.residual])
        key = rows.view[:, 0] * views + rows.view[:, -1]
        order = np.argsort(key, kind="stable")
        for index in np.split(order, np.flatnonzero(np.diff(key[order])) + 1) if len(order) else ():
            places = [POSE * n + np.arange(POSE) for n in rows.view[index[0]]] + [np.arange(size - SHARED, size + 1)]
            place, J = np.concatenate(places), columns[index]
            whole[np.ix_(place, place)] += J.T @ (J * rows.weight[index, None])
    return whole[:-1, :-1], whole[:-1, -1]


MAD = 1.4826
"""Standard deviation of a normal law over the median of its absolute values."""
ROBUST = 3.0
"""Cauchy's loss: a residual of three sigma has half the weight of a small one."""


def robust(squares: Array, times: Array | float = 1.0) -> tuple[Array, float]:
    """(weights, cost) of Cauchy's loss for squared residuals in sigma, each `times` a constant weight."""
    return times / (1.0 + squares / ROBUST**2), float((times * ROBUST**2 * np.log1p(squares / ROBUST**2)).sum())


def median_of_chi_square(degrees: int) -> float:
    """Median over mean of a chi-square distribution (Wilson and Hilferty 1931)."""
    return (1 - 2 / (9 * degrees)) ** 3


def pose_halves(rows: Rows, views: int) -> Array:
    """[V, N, N]: H with H H^T the covariance of what each view has of its own by its rows alone, with all that is shared held."""
    size = rows.by_view.shape[2]
    halves = np.zeros((views, size, size))
    for number in range(views):
        J = rows.of_view(number)[0]
        strength, directions = np.linalg.eigh(J.T @ J)
        kept = strength > 1e-9 * max(float(strength[-1]), 1e-12)
        halves[number] = directions / np.sqrt(np.where(kept, strength, np.inf))
    return halves


SETTLED = 1e-7
"""A step of fewer metres and radians ends the iteration: a tenth of a micrometre."""


@dataclass(frozen=True, eq=False)
class Problem:
    """The terms; prior [S] sigma of the shared parameters, 0 for those that are fixed; fixed [V] poses that do not move."""

    terms: Sequence[Term]
    prior: Array
    fixed: NDArray[np.bool_]

    def linearise(self, poses: Array, shared: Shared) -> tuple[Array, Array, float]:
        """(matrix [D, D], gradient [D], cost); rows and columns of what is fixed are zero."""
        rows = [term.rows(poses, shared) for term in self.terms]
        matrix, gradient = normal_equations(rows, len(poses))
        free = self.prior > 0
        sigma, deviation = np.where(free, self.prior, 1.0), shared.deviation()
        last = np.arange(len(gradient) - SHARED, len(gradient))
        matrix[last, last] += 1.0 / sigma**2
        gradient[last] += deviation / sigma**2
        held = np.concatenate([np.repeat(self.fixed, POSE), ~free])
        matrix[held], matrix[:, held], gradient[held] = 0.0, 0.0, 0.0
        return matrix, gradient, add_up(r.cost for r in rows) + float(((deviation / sigma)[free] ** 2).sum())


@dataclass(frozen=True, eq=False)
class Solution:
    """poses [V, 4, 4], the shared parameters, and the matrix [D, D], D = 6 V + S, zero where nothing moves."""

    poses: Array
    shared: Shared
    matrix: Array
    iterations: int
    converged: bool

    def covariance(self) -> Array:
        """[D, D]: the inverse of the normal equations at the solution."""
        free = np.ix_(*[np.diag(self.matrix) > 0] * 2)
        covariance = np.zeros_like(self.matrix)
        covariance[free] = np.linalg.inv(_regular(self.matrix[free]))
        return covariance

    def of_views(self) -> Array:
        """[V, 6, 6]: the covariance of each pose."""
        count = len(self.poses)
        blocks = self.covariance()[:-SHARED, :-SHARED].reshape(count, POSE, count, POSE)
        return blocks[range(count), :, range(count)]


def minimise(problem: Problem, poses: Array, shared: Shared, most: int) -> Solution:
    """The poses and shared parameters of least robust cost near a start, in at most `most` steps (Levenberg-Marquardt)."""
    damping, converged, iterations = 1e-6, False, 0
    matrix, gradient, cost = problem.linearise(poses, shared)
    while iterations < most and not converged:
        iterations += 1
        free, step = np.diag(matrix) > 0, np.zeros(len(gradient))
        part = matrix[np.ix_(free, free)]
        step[free] = np.linalg.solve(_regular(part + damping * np.diag(np.diag(part))), -gradient[free])
        new = moved(poses, step[:-SHARED].reshape(-1, POSE)), shared.moved(step[-SHARED:])
        linear = problem.linearise(*new)
        converged = float(np.abs(step).max()) < SETTLED
        if linear[2] <= cost:
            (poses, shared), (matrix, gradient, cost) = new, linear
            damping *= 0.1
        else:
            damping = max(damping, 1e-6) * 10
            converged = converged or damping > 1e6
    return Solution(poses, shared, matrix, iterations, converged)


def _regular(matrix: Array) -> Array:
    """The matrix with so little on its diagonal that directions without any information (10 m or rad) can be inverted."""
    return matrix + 1e-2 * np.eye(len(matrix))
