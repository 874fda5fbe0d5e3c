"""The terms of the joint problem: the parameters that all views share, and rows of residuals over sigma with derivatives.

Each term is fixed data: corners, the board's depth or the object's. Its rows depend on the poses [V, 4, 4] (T_board_cam) and on
the shared parameters. The sigma of depth grows with its scale: otherwise a smaller scale, which makes noise smaller, would
always fit better.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as variance_ratio

from schemas.base import Array, Pose, frozen_array
from schemas.capture import CaptureCamera, DepthCorrection
from schemas.job.captures import Estimation
from workers.capture.poses.markers import (
    MATERIAL,
    corner_sigma,
    cross_matrix,
    derivative_of_projection,
    exponential,
    logarithm,
)
from workers.capture.poses.observation import Patches
from workers.geometry.frames import pose
from workers.geometry.lens import rays_of_pixels

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


MODES = (2, 1, 5)
"""How many of the eight coordinates of a marker's corners are its place, the growth of its sides, and the rest: its shape."""


LEVEL = 1e-3
"""Level of the F tests by which markers ask for another camera than camera.json's: one capture in a thousand is wronged."""
SWEPT = 0.005
"""Sigma of the motion of a hand while an image is read, metres and radians: 0.15 m/s and 9 degrees/s for 1/30 s. A step across
the rows and a turn that undoes it look alike on a board: of the two, the markers tell only the sum."""
EXPLAINED = 0.2
"""Motion that explains a smaller share of the misfit is no finding: noise of a lens or of hidden markers is alike nearby."""


@dataclass(frozen=True, eq=False)
class Rolling:
    """By how much poses would move, motion [V, 6], if rows were read in turn; covariance [V, 6, 6] of the poses then."""

    motion: Array
    covariance: Array

    @property
    def note(self) -> str:
        """What the user is told."""
        mm = 1000 * float(np.median(np.linalg.norm(self.motion[:, :3], axis=1)))
        return (
            f"the corners lie as if the camera moved while the rows of an image were read, which moves the poses by {mm:.1f} mm: "
            "hold it still for each photograph, or use a global shutter"
        )


@dataclass(frozen=True, eq=False)
class CornerTerm:
    """Corners of all views, those of a marker together: view [K] index, board [K, 3] nominal metres, rays [K, 2].

    sigma_px [4]: of a marker's place, growth and shape, as `MODES` has them, and of a corner that is no marker's. What a camera
    does to edges changes the size of markers, and slopes of refined edges their shape, more than either moves them: weighed
    alike, both would move the camera.

    square [K]: which are of a marker; the others, of a chessboard, have no side that grows; None: all are. With `seen`
    (their pixels [K, 2], centres at +0.5, and the camera of the rays) its intrinsics can be estimated as well.
    """

    view: NDArray[np.int64]
    board: Array
    rays: Array
    focal: Array
    sigma_px: Array
    square: NDArray[np.bool_] | None = None
    seen: tuple[Array, CaptureCamera] | None = None

    @cached_property
    def own(self) -> NDArray[np.bool_]:
        """[K]: which corners are of a marker."""
        return np.ones(len(self.board), np.bool_) if self.square is None else self.square

    @cached_property
    def grown(self) -> Array:
        """[K, 2]: how corners move, pixels, where each side of their marker looks longer by a pixel."""
        return outward_motion(self.focal * self.rays, self.own)

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """Two rows a corner: each mode of a marker over its sigma, as one symmetric matrix, so that a row stays a corner's."""
        R, t = poses[self.view, :3, :3], poses[self.view, :3, 3]
        outwards = outward_motion(self.board, self.own)
        p = np.einsum("kji,kj->ki", R, shared.print_scale * self.board + shared.growth_m * outwards - t)
        z = np.maximum(p[:, 2], 1e-3)
        x, y = p[:, 0] / z, p[:, 1] / z
        rays, by_camera = self._rays(shared)
        off = np.stack([x, y], axis=1) - rays
        focal = self.focal * (1.0 + np.array(shared.camera[:2]))  # else a longer one would make noise smaller
        by_point = derivative_of_projection(x, y, z, focal)
        values = np.zeros((len(p), 2, 1 + POSE + SHARED))
        residual, by_pose, by_shared = values[..., 0], values[..., 1 : 1 + POSE], values[..., 1 + POSE :]
        residual[:] = focal * off + shared.growth_px * self.grown
        by_pose[:] = np.concatenate([-by_point, by_point @ cross_matrix(p)], axis=2)
        by_shared[:, :, PRINT_SCALE] = np.einsum("kij,kj->ki", by_point, np.einsum("kji,kj->ki", R, self.board))
        by_shared[:, :, GROWTH_M] = np.einsum("kij,kj->ki", by_point, np.einsum("kji,kj->ki", R, outwards))
        by_shared[:, :, GROWTH_PX] = self.grown
        by_shared[:, :, CAMERA] = -focal[:, None] * by_camera
        by_shared[:, :, CAMERA][:, [0, 1], [0, 1]] += self.focal * off
        white = self._over_sigma(values)
        weight, cost = robust((white[..., 0] ** 2).sum(axis=1))
        flat = white.reshape(-1, white.shape[2])
        return Rows(
            flat[:, 0], np.repeat(self.view, 2), flat[:, 1 : 1 + POSE], flat[:, 1 + POSE :], np.repeat(weight, 2), cost
        )  # fmt: skip

    def modes(self, values: Array) -> tuple[Array, Array, Array]:
        """(place, growth, shape), each [M, 4, 2, D]: orthogonal parts of values [K, 2, D] of the corners of M markers."""
        quads = values[self.own].reshape(-1, 4, 2, values.shape[2])
        growth = self.grown[self.own].reshape(-1, 4, 2)
        growth = growth - growth.mean(axis=1, keepdims=True)
        growth /= np.linalg.norm(growth, axis=(1, 2), keepdims=True)
        place = np.broadcast_to(quads.mean(axis=1, keepdims=True), quads.shape)
        grown = np.einsum("mij,mijd->md", growth, quads)[:, None, None] * growth[..., None]
        return place, grown, quads - place - grown

    def _over_sigma(self, values: Array) -> Array:
        over: Array = values / self.sigma_px[3]
        place, growth, shape = (part / sigma for part, sigma in zip(self.modes(values), self.sigma_px, strict=False))
        over[self.own] = (place + growth + shape).reshape(-1, *values.shape[1:])
        return over

    def measured(self, poses: Array, shared: Shared, spec: Estimation) -> "CornerTerm":
        """The term with sigma_px as its residuals have it.

        The variance of each mode is its median square over that of chi-square, over the share of its coordinates that the
        poses leave (restricted maximum likelihood; the median resists what hides markers).
        """
        rows, sigma_px = self.rows(poses, shared), self.sigma_px.copy()
        by_pose = rows.by_first * np.sqrt(rows.weight)[:, None]
        taken = np.einsum("nj,njk->nk", by_pose, pose_halves(rows, len(poses))[rows.first])
        values = np.concatenate([rows.residual[:, None], taken], axis=1).reshape(-1, 2, 1 + POSE)
        parts = [*self.modes(values), values[~self.own][:, None]]
        for mode, (part, degrees) in enumerate(zip(parts, (*MODES, 2), strict=True)):
            squares = (part**2).sum(axis=(1, 2))
            total = degrees * len(squares)
            left = total - float(squares[:, 1:].sum())
            if left > 0.5 * degrees:  # else the poses take up all that there is
                ratio = float(np.median(squares[:, 0])) / (degrees * median_of_chi_square(degrees))
                sigma_px[mode] = corner_sigma(sigma_px[mode] ** 2 * ratio * total / left, left, spec)
        return dataclasses.replace(self, sigma_px=sigma_px)

    def misfit(self, poses: Array, shared: Shared) -> Array:
        """[V]: variance of the corners of each view over what their sigma says, at least 1: a view may be blurred."""
        residual, ratio = np.abs(self.rows(poses, shared).residual), np.ones(len(poses))
        for number in np.unique(self.view):
            own = residual[np.repeat(self.view == number, 2)]
            if len(own) > POSE:
                ratio[number] = (MAD * float(np.median(own))) ** 2 * len(own) / (len(own) - POSE)
        return np.maximum(ratio, 1.0)

    def rolling(self, poses: Array, shared: Shared, height: int) -> "Rolling | None":
        """What a rolling shutter does to each pose; None where corners do not ask for it, or it moves the poses by too little.

        Each view may have moved evenly from its first row to its last of `height`, which one step of Gauss and Newton finds
        beside its pose. All corners count alike: what rows do to markers is noise to their modes. An F test over all views.
        """
        rows = dataclasses.replace(self, sigma_px=np.full(4, self.sigma_px[0])).rows(poses, shared)
        share, prior = np.repeat(self.focal[1] * self.rays[:, 1] / height, 2), np.repeat([0.0, SWEPT**-2], POSE)
        motion, covariance, gain, left = np.zeros((len(poses), POSE)), np.zeros((len(poses), POSE, POSE)), 0.0, 0.0
        for number in range(len(poses)):
            own = rows.first == number
            root = np.sqrt(rows.weight[own])
            both = root[:, None] * np.concatenate([rows.by_first[own], share[own, None] * rows.by_first[own]], axis=1)
            residual, inverse = (
                root * rows.residual[own],
                np.linalg.pinv(both.T @ both + np.diag(prior), hermitian=True),
            )
            step = -inverse @ (both.T @ residual)
            motion[number], covariance[number] = step[:POSE], inverse[:POSE, :POSE]
            gain, left = gain - float(step @ (both.T @ residual)), left + float(residual @ residual)
        degrees = POSE * len(poses), len(rows.residual) - 2 * POSE * len(poses)
        shift = np.linalg.norm(motion[:, :3], axis=1) / np.linalg.norm(poses[:, :3, 3], axis=1)
        if min(degrees) <= 0 or float(np.median(shift)) < MATERIAL:
            return None
        variance = (left - gain) / degrees[1]
        sure = gain > EXPLAINED * left and variance_ratio.sf(gain / (degrees[0] * variance), *degrees) < LEVEL
        return Rolling(motion, variance * covariance) if sure else None

    def _rays(self, shared: Shared) -> tuple[Array, Array]:
        """([K, 2] rays, [K, 2, 5] their derivatives by the numbers of the camera; 0 where those are not estimated)."""
        if self.seen is None:
            return self.rays, np.zeros((len(self.rays), 2, len(shared.camera)))
        pixels, camera = self.seen
        now = np.array(shared.camera)

        def rays(numbers: Array) -> Array:
            changed = corrected_camera(camera, numbers)
            return rays_of_pixels(pixels, changed.intrinsics, changed.lens)

        steps = DIFFERENCE * np.eye(len(now))
        by = [(rays(now + step) - rays(now - step)) / (2 * DIFFERENCE) for step in steps]
        return rays(now), np.stack(by, axis=2)


DIFFERENCE = 1e-5
"""Step of the numbers of a camera by which rays are differentiated: rays are exact to 1e-11."""


def corrected_camera(camera: CaptureCamera, numbers: Sequence[float] | Array) -> CaptureCamera:
    """The camera after the corrections (fx, fy, cx, cy, k1) of `Shared`."""
    k, (fx, fy, cx, cy, k1) = camera.intrinsics, (float(number) for number in numbers)
    update = {"fx": k.fx * (1 + fx), "fy": k.fy * (1 + fy), "cx": k.cx + k.fx * cx, "cy": k.cy + k.fy * cy}
    lens = frozen_array(camera.lens + k1 * np.eye(8)[0])
    return dataclasses.replace(camera, intrinsics=k.model_copy(update=update), lens=lens)


def outward_motion(corners: Array, square: NDArray[np.bool_] | None = None) -> Array:
    """[K, D]: how corners [K, D] of quads, of which each is in a plane, move where each side of a quad gets longer by 1.

    Each edge moves outwards by a half, along its normal; a corner stays where its two edges meet. square [K]: as in CornerTerm.
    """
    own = np.ones(len(corners), np.bool_) if square is None else square
    quads = corners[own].reshape(-1, 4, corners.shape[1])
    along = np.roll(quads, -1, axis=1) - quads
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    before = np.roll(along, 1, axis=1)
    # n1 d = n2 d = 1/2 with normals across the unit directions a and b: d = (a - b) / (2 |a x b|), outwards for either sense.
    sine = np.sqrt(1.0 - (before * along).sum(axis=2, keepdims=True) ** 2)
    moved = np.zeros_like(corners)
    moved[own] = ((before - along) / (2.0 * sine)).reshape(-1, corners.shape[1])
    return moved


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
