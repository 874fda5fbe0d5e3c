"""Levenberg-Marquardt over the poses of all views and the shared parameters, by dense normal equations."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky

from schemas.base import Array
from workers.capture.poses.motion import moved
from workers.capture.poses.rows import POSE, SHARED, Rows, normal_equations
from workers.capture.poses.shared import Shared

SETTLED = 1e-7
"""A step of fewer metres and radians ends the iteration: a tenth of a micrometre."""


class Term(Protocol):
    """Something that is measured."""

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """Its residuals and derivatives at the poses [V, 4, 4]."""


@dataclass(frozen=True, eq=False)
class Problem:
    """The terms; prior [9] sigma of the shared parameters, 0 for those that are fixed; fixed [V] poses that do not move."""

    terms: Sequence[Term]
    prior: Array
    fixed: np.ndarray


@dataclass(frozen=True, eq=False)
class Solution:
    """poses [V, 4, 4], the shared parameters, and the covariance [D, D], D = 6 V + 9, zero where nothing moves."""

    poses: Array
    shared: Shared
    matrix: Array
    iterations: int
    converged: bool

    def covariance(self) -> Array:
        """[D, D]: the inverse of the normal equations at the solution."""
        free = np.diag(self.matrix) > 0
        found = np.zeros_like(self.matrix)
        upper = cholesky(_regular(self.matrix[np.ix_(free, free)]))
        half = np.linalg.inv(upper)
        found[np.ix_(free, free)] = half @ half.T
        return found


def minimise(problem: Problem, poses: Array, shared: Shared, most: int) -> Solution:
    """The poses and shared parameters of least robust cost near a start, in at most `most` steps."""
    damping, converged, iterations = 1e-6, False, 0
    matrix, gradient, cost = _linearise(problem, poses, shared)
    while iterations < most and not converged:
        iterations += 1
        step = _step(matrix, gradient, damping)
        new_poses = np.stack(
            [moved(T, motion) for T, motion in zip(poses, step[:-SHARED].reshape(-1, POSE), strict=True)]
        )
        new_shared = shared.moved(step[-SHARED:])
        new_matrix, new_gradient, new_cost = _linearise(problem, new_poses, new_shared)
        small = float(np.abs(step).max()) < SETTLED
        if new_cost <= cost:
            poses, shared, matrix, gradient, cost = new_poses, new_shared, new_matrix, new_gradient, new_cost
            damping *= 0.1
            converged = small
        else:
            damping = max(damping, 1e-6) * 10
            converged = small or damping > 1e6
    return Solution(poses, shared, matrix, iterations, converged)


def _step(matrix: Array, gradient: Array, damping: float) -> Array:
    free = np.diag(matrix) > 0
    part = matrix[np.ix_(free, free)]
    step = np.zeros(len(gradient))
    step[free] = cho_solve(cho_factor(_regular(part + damping * np.diag(np.diag(part)))), -gradient[free])
    return step


def _regular(matrix: Array) -> Array:
    """The matrix with so little on its diagonal that directions without any information (10 m or rad) can be factored."""
    return matrix + 1e-2 * np.eye(len(matrix))


def _linearise(problem: Problem, poses: Array, shared: Shared) -> tuple[Array, Array, float]:
    """(matrix, gradient, cost); rows and columns of what is fixed are zero."""
    rows = [term.rows(poses, shared) for term in problem.terms]
    matrix, gradient = normal_equations(rows, len(poses))
    free = problem.prior > 0
    sigma = np.where(free, problem.prior, 1.0)
    deviation = shared.deviation()
    first = len(gradient) - SHARED
    matrix[range(first, len(gradient)), range(first, len(gradient))] += 1.0 / sigma**2
    gradient[first:] += deviation / sigma**2
    held = np.concatenate([np.repeat(problem.fixed, POSE), ~free])
    matrix[held], matrix[:, held], gradient[held] = 0.0, 0.0, 0.0
    return matrix, gradient, sum(r.cost for r in rows) + float(((deviation / sigma)[free] ** 2).sum())
