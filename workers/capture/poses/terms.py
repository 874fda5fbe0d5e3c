"""The terms of the joint estimate as rows of residuals over sigma: corners, the board's depth, the object's depth.

Each term is fixed data; its rows depend on the poses [V, 4, 4] (T_board_cam) and on the shared parameters. The sigma of
depth grows with its scale: otherwise a smaller scale, which makes noise smaller, would always fit better.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.capture.poses.motion import cross_matrix
from workers.capture.poses.observation import Patches
from workers.capture.poses.reprojection import derivative_of_projection
from workers.capture.poses.rows import POSE, SHARED, Rows
from workers.capture.poses.shared import DEPTH_SCALE, PRINT_SCALE, Shared

ROBUST = 3.0
"""Cauchy's loss: a residual of three sigma has half the weight of a small one."""


@dataclass(frozen=True, eq=False)
class CornerTerm:
    """Corners of all views: view [K] index, board [K, 3] nominal metres, rays [K, 2]; sigma in pixels."""

    view: NDArray[np.int64]
    board: Array
    rays: Array
    focal: Array
    sigma_px: float

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """Two rows a corner."""
        R, t = poses[self.view, :3, :3], poses[self.view, :3, 3]
        p = np.einsum("kji,kj->ki", R, shared.print_scale * self.board - t)
        z = np.maximum(p[:, 2], 1e-3)
        x, y = p[:, 0] / z, p[:, 1] / z
        residual = self.focal * (np.stack([x, y], axis=1) - self.rays) / self.sigma_px
        by_point = derivative_of_projection(x, y, z, self.focal) / self.sigma_px
        by_pose = np.concatenate([-by_point, by_point @ cross_matrix(p)], axis=2)
        by_shared = np.zeros((len(p), 2, SHARED))
        by_shared[:, :, PRINT_SCALE] = np.einsum("kij,kj->ki", by_point, np.einsum("kji,kj->ki", R, self.board))
        weight, cost = robust((residual**2).sum(axis=1))
        return _of_one_view(
            residual.ravel(), np.repeat(self.view, 2), by_pose.reshape(-1, POSE), by_shared.reshape(-1, SHARED),
            np.repeat(weight, 2), cost,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class BoardTerm:
    """Depth of the board: patches of all views lie on its plane. view [P]; sigma_m [P]; inflation of their variance."""

    view: NDArray[np.int64]
    patches: Patches
    sigma_m: Array
    inflation: float

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """One row a patch: its height over the board."""
        p, sigma_m = shared.corrected(self.patches), self.sigma_m * shared.scale
        up = poses[self.view, 2, :3]
        residual = ((p * up).sum(axis=1) + poses[self.view, 2, 3]) / sigma_m
        by_point = up / sigma_m[:, None]
        by_shared = np.einsum("pi,pij->pj", by_point, shared.derivative(self.patches))
        by_shared[:, DEPTH_SCALE] -= residual / shared.scale
        weight, cost = robust(residual**2)
        by_pose = by_motion(by_point, p)
        return _of_one_view(residual, self.view, by_pose, by_shared, weight / self.inflation, cost / self.inflation)


@dataclass(frozen=True, eq=False)
class ObjectTerm:
    """Depth of the object: patches of two views lie on one surface. pairs [N, 2] of patches, normal [N, 3] board axes."""

    view: NDArray[np.int64]
    patches: Patches
    pairs: NDArray[np.int64]
    normal: Array
    sigma_m: Array
    inflation: float

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """One row a pair: the distance between the two along their common normal."""
        p, by = shared.corrected(self.patches), shared.derivative(self.patches)
        R = poses[self.view, :3, :3]
        placed = np.einsum("pij,pj->pi", R, p) + poses[self.view, :3, 3]
        a, b = self.pairs.T
        sigma_m = self.sigma_m * shared.scale
        residual = ((placed[a] - placed[b]) * self.normal).sum(axis=1) / sigma_m
        unit = self.normal / sigma_m[:, None]
        along_a, along_b = (np.einsum("nji,nj->ni", R[index], unit) for index in (a, b))
        by_shared = np.einsum("ni,nij->nj", along_a, by[a]) - np.einsum("ni,nij->nj", along_b, by[b])
        by_shared[:, DEPTH_SCALE] -= residual / shared.scale
        weight, cost = robust(residual**2)
        return Rows(
            residual, self.view[a], by_motion(along_a, p[a]), self.view[b], -by_motion(along_b, p[b]), by_shared,
            weight / self.inflation, cost / self.inflation,
        )  # fmt: skip


def by_motion(along: Array, points: Array) -> Array:
    """[N, 6]: derivative, by a small motion of the camera, of the coordinate of its points [N, 3] along [N, 3]."""
    return np.concatenate([along, np.cross(points, along)], axis=1)


def robust(squares: Array) -> tuple[Array, float]:
    """(weights, cost) of Cauchy's loss for squared residuals in sigma."""
    return 1.0 / (1.0 + squares / ROBUST**2), float((ROBUST**2 * np.log1p(squares / ROBUST**2)).sum())


def _of_one_view(
    residual: Array, view: NDArray[np.int64], by_pose: Array, by_shared: Array, weight: Array, cost: float
) -> Rows:
    none = np.full(len(view), -1, np.int64)
    return Rows(residual, view, by_pose, none, np.zeros((len(view), POSE)), by_shared, weight, cost)
