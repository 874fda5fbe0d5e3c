"""The terms of the joint problem: the parameters that all views share, and rows of residuals over sigma with derivatives.

Each term is fixed data: corners, the board's depth or the object's. Its rows depend on the poses [V, 4, 4] (T_board_cam) and on
the shared parameters. The sigma of depth grows with its scale: otherwise a smaller scale, which makes noise smaller, would
always fit better.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture import DepthCorrection
from schemas.job.captures import Estimation
from workers.capture.poses.markers import (
    cross_matrix,
    exponential,
    logarithm,
)
from workers.capture.poses.observation import Patches
from workers.geometry.frames import pose

NAMES = (
    "offset_m",
    "scale",
    "shift_x_m",
    "shift_y_m",
    "shift_z_m",
    "turn_x_rad",
    "turn_y_rad",
    "turn_z_rad",
    "print_scale",
    "growth_m",
    "growth_px",
    "fx",
    "fy",
    "cx",
    "cy",
    "k1",
)
"""The shared parameters in the order in which they stand in every array of S = 16 numbers.

A printed square may look larger than it is: by `growth_m` where ink spreads, by `growth_px` where the camera sharpens. The last
five correct camera.json: all but k1 are shares of its fx and fy.
"""
DEPTH_SCALE = NAMES.index("scale")
PRINT_SCALE = NAMES.index("print_scale")
GROWTH_M, GROWTH_PX = NAMES.index("growth_m"), NAMES.index("growth_px")
CAMERA = slice(NAMES.index("fx"), NAMES.index("k1") + 1)

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
    camera: tuple[float, ...] = (0.0,) * 5

    def corrected(self, patches: Patches) -> Array:
        """[P, 3] metres, camera axes: the middles of patches after the correction."""
        raw = self.scale * patches.ray_z + self.offset_m * patches.ray
        return raw @ self.T_cam_depth[:3, :3].T + self.T_cam_depth[:3, 3]

    def derivative(self, patches: Patches) -> Array:
        """[P, 3, S]: of `corrected` by the parameters; those of registration are a shift and a turn of what is corrected."""
        R = self.T_cam_depth[:3, :3]
        turned = (self.scale * patches.ray_z + self.offset_m * patches.ray) @ R.T
        by = np.zeros((len(patches), 3, len(NAMES)))
        by[:, :, 0] = patches.ray @ R.T
        by[:, :, 1] = patches.ray_z @ R.T
        by[:, :, 2:5] = np.eye(3)
        by[:, :, 5:8] = -cross_matrix(turned)
        return by

    def moved(self, step: Array) -> "Shared":
        """The parameters after a step [S]."""
        R = exponential(step[5:8]) @ self.T_cam_depth[:3, :3]
        U, _, V = np.linalg.svd(R)
        T = frozen_array(pose(U @ V, self.T_cam_depth[:3, 3] + step[2:5]))
        plain = np.array([self.offset_m, self.scale, self.print_scale, self.growth_m, self.growth_px, *self.camera])
        offset_m, scale, print_scale, growth_m, growth_px, *camera = (
            plain + step[[0, 1, *range(8, len(step))]]
        ).tolist()
        return Shared(offset_m, scale, T, print_scale, growth_m, growth_px, tuple(camera))

    def deviation(self) -> Array:
        """[S]: how far each parameter is from its expected value."""
        turn = logarithm(self.T_cam_depth[:3, :3])
        parts = [self.offset_m, self.scale - 1, *self.T_cam_depth[:3, 3], *turn, self.print_scale - 1]
        return np.array([*parts, self.growth_m, self.growth_px, *self.camera], dtype=np.float64)

    def correction(self, identified: tuple[str, ...]) -> DepthCorrection:
        """What the other stages are told."""
        return DepthCorrection(self.offset_m, self.scale, self.T_cam_depth, identified)


def prior_sigma(spec: Estimation, has_depth: bool) -> Array:
    """[S]: how far each parameter may be from its expected value, one sigma; 0 for those that are not estimated."""
    trusts_print = spec.trust == "print"
    scale, print_ = (SCALE_BY_PRINT, 0.0) if trusts_print else (SCALE, PRINT)
    of_depth = np.array([OFFSET_M, scale, *[SHIFT_M] * 3, *[TURN_RAD] * 3, print_]) * has_depth
    return np.concatenate([of_depth, [GROW_M, GROW_PX], np.zeros(CAMERA.stop - CAMERA.start)])


def identified(sigma: Array, prior: Array) -> tuple[str, ...]:
    """Names of the parameters that the capture determines, by their sigma [9] after and before."""
    return tuple(name for name, after, before in zip(NAMES, sigma, prior, strict=True) if after < IDENTIFIED * before)


POSE = 6
SHARED = len(NAMES)


@dataclass(frozen=True, eq=False)
class Rows:
    """N residuals in standard deviations, each of one view or, with `second`, of two.

    first, second [N]: index of the view; by_first, by_second [N, 6] derivatives by small motions; by_shared [N, S]; weight [N]:
    robust weight over the inflation of the term's variance; cost: robust, of all rows.
    """

    residual: Array
    first: NDArray[np.int64]
    by_first: Array
    by_shared: Array
    weight: Array
    cost: float
    second: NDArray[np.int64] | None = None
    by_second: Array | None = None


def normal_equations(terms: Sequence[Rows], views: int) -> tuple[Array, Array]:
    """(J^T W J [D, D], J^T W r [D]), D = 6 V + S, the shared parameters last."""
    size = POSE * views + SHARED
    blocks = np.zeros((views, POSE, views, POSE))
    mixed = np.zeros((views, POSE, SHARED))
    shared, gradient = np.zeros((SHARED, SHARED)), np.zeros((views, POSE))
    shared_gradient = np.zeros(SHARED)
    for rows in terms:
        weighted = rows.by_shared * rows.weight[:, None]
        shared += weighted.T @ rows.by_shared
        shared_gradient += weighted.T @ rows.residual
        _add(rows, rows.first, rows.by_first, blocks, mixed, gradient)
        if rows.second is not None and rows.by_second is not None:
            _add(rows, rows.second, rows.by_second, blocks, mixed, gradient)
            _add_pairs(rows, rows.second, rows.by_second, blocks)
    matrix = np.zeros((size, size))
    poses = POSE * views
    matrix[:poses, :poses] = blocks.reshape(poses, poses)
    matrix[:poses, poses:] = mixed.reshape(poses, SHARED)
    matrix[poses:, :poses] = matrix[:poses, poses:].T
    matrix[poses:, poses:] = shared
    return matrix, np.concatenate([gradient.ravel(), shared_gradient])


def _add(rows: Rows, view: NDArray[np.int64], by_view: Array, blocks: Array, mixed: Array, gradient: Array) -> None:
    """Adds what one side of the rows says of its own view."""
    order = np.argsort(view, kind="stable")
    starts = np.flatnonzero(np.diff(view[order], prepend=-1))
    for start, stop in zip(starts, [*starts[1:], len(order)], strict=True):
        index = order[start:stop]
        number, J = view[index[0]], by_view[index]
        weighted = J * rows.weight[index, None]
        blocks[number, :, number] += weighted.T @ J
        mixed[number] += weighted.T @ rows.by_shared[index]
        gradient[number] += weighted.T @ rows.residual[index]


def _add_pairs(rows: Rows, second: NDArray[np.int64], by_second: Array, blocks: Array) -> None:
    """Adds what rows of two views say of both."""
    key = rows.first * len(blocks) + second
    order = np.argsort(key, kind="stable")
    outer = (rows.by_first[order] * rows.weight[order, None])[:, :, None] * by_second[order][:, None]
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    sums = np.add.reduceat(outer, starts, axis=0)
    for a, b, block in zip(rows.first[order[starts]], second[order[starts]], sums, strict=True):
        blocks[a, :, b] += block
        blocks[b, :, a] += block.T


MAD = 1.4826
"""Standard deviation of a normal law over the median of its absolute values."""
ROBUST = 3.0
"""Cauchy's loss: a residual of three sigma has half the weight of a small one."""


def pose_halves(rows: Rows, views: int) -> Array:
    """[V, 6, 6]: H with H H^T the covariance of each view's pose by its rows alone, with all that is shared held."""
    halves = np.zeros((views, POSE, POSE))
    for number in range(views):
        own = rows.first == number
        J, weight = rows.by_first[own], rows.weight[own][:, None]
        strength, directions = np.linalg.eigh(J.T @ (weight * J))
        kept = strength > 1e-9 * max(float(strength[-1]), 1e-12)
        halves[number] = directions / np.sqrt(np.where(kept, strength, np.inf))
    return halves


def median_of_chi_square(degrees: int) -> float:
    """Median over mean of a chi-square distribution (Wilson and Hilferty 1931)."""
    return (1 - 2 / (9 * degrees)) ** 3


@dataclass(frozen=True, eq=False)
class BoardTerm:
    """Depth of the board: patches of all views lie on its plane. view, sigma_m, inflation of their variance: each [P]."""

    view: NDArray[np.int64]
    patches: Patches
    sigma_m: Array
    inflation: Array

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """One row a patch: its height over the board."""
        p, sigma_m = shared.corrected(self.patches), self.sigma_m * shared.scale
        up = poses[self.view, 2, :3]
        residual = ((p * up).sum(axis=1) + poses[self.view, 2, 3]) / sigma_m
        by_point = up / sigma_m[:, None]
        by_shared = np.einsum("pi,pij->pj", by_point, shared.derivative(self.patches))
        by_shared[:, DEPTH_SCALE] -= residual / shared.scale
        weight, cost = robust(residual**2, 1.0 / self.inflation)
        return Rows(residual, self.view, by_motion(by_point, p), by_shared, weight, cost)


@dataclass(frozen=True, eq=False)
class ObjectTerm:
    """Depth of the object: patches of two views lie on one surface. pairs [N, 2] of patches, normal [N, 3] board axes."""

    view: NDArray[np.int64]
    patches: Patches
    pairs: NDArray[np.int64]
    normal: Array
    sigma_m: Array
    inflation: Array

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
        weight, cost = robust(residual**2, 1.0 / self.inflation)
        by_a, by_b = by_motion(along_a, p[a]), -by_motion(along_b, p[b])
        return Rows(residual, self.view[a], by_a, by_shared, weight, cost, self.view[b], by_b)


def by_motion(along: Array, points: Array) -> Array:
    """[N, 6]: derivative, by a small motion of the camera, of the coordinate of its points [N, 3] along [N, 3]."""
    return np.concatenate([along, np.cross(points, along)], axis=1)


def robust(squares: Array, times: Array | float = 1.0) -> tuple[Array, float]:
    """(weights, cost) of Cauchy's loss for squared residuals in sigma, each `times` a constant weight."""
    return times / (1.0 + squares / ROBUST**2), float((times * ROBUST**2 * np.log1p(squares / ROBUST**2)).sum())
