"""Corners in the joint problem: their rows, the noise of each mode of a marker, and what a rolling shutter does to them."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as variance_ratio

from schemas.base import Array, frozen_array
from schemas.capture import CaptureCamera
from schemas.job.captures import Estimation
from workers.capture.poses.markers import MATERIAL, corner_sigma, cross_matrix, derivative_of_projection
from workers.capture.poses.terms import (
    CAMERA,
    GROWTH_M,
    GROWTH_PX,
    MAD,
    POSE,
    PRINT_SCALE,
    SHARED,
    Rows,
    Shared,
    median_of_chi_square,
    pose_halves,
    robust,
)
from workers.geometry.pixels import rays_of_pixels

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
