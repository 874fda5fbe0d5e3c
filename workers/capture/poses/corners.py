"""Corners of all views: their rows, and the noise of each mode of a marker."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.capture import CaptureCamera
from schemas.job.captures import Estimation
from workers.capture.poses.observation import Corners
from workers.capture.poses.terms import (
    GROWTH_M,
    GROWTH_PX,
    MAD,
    POSE,
    PRINT_SCALE,
    SHARED,
    Rows,
    Shared,
    cross_matrix,
    median_of_chi_square,
    pose_halves,
    robust,
)

MODES = (2, 1, 5)
"""How many of the eight coordinates of a marker's corners are its place, the growth of its sides, and the rest: its shape."""
FLOOR_PX = 0.02
"""No corner is taken to be better than this."""
PRIOR_RESIDUALS = 2
"""The expected sigma of a corner counts as much as so many measured residuals."""


def corner_sigma(variance: float, free: float, spec: Estimation) -> float:
    """Standard deviation, pixels, by the variance of residuals, `free` of them left by what was fitted, and by the expected."""
    mixed = (free * variance + PRIOR_RESIDUALS * spec.corner_px**2) / (free + PRIOR_RESIDUALS)
    return max(FLOOR_PX, float(np.sqrt(mixed)))


@dataclass(frozen=True, eq=False)
class CornerTerm:
    """Corners of all views, those of a marker together: view [K] index, board [K, 3] nominal metres, rays [K, 2].

    square [K]: which are of a marker; the others, of a chessboard, have no side that grows. sigma_px [4]: of a marker's place,
    growth and shape, as `MODES` has them, and of a corner that is no marker's. What a camera does to edges changes the size of
    markers, and slopes of refined edges their shape, more than either moves them: weighed alike, both would move the camera.
    """

    view: NDArray[np.int64]
    board: Array
    rays: Array
    focal: Array
    sigma_px: Array
    square: NDArray[np.bool_]

    @staticmethod
    def of(corners: Sequence[Corners], camera: CaptureCamera, sigma_px: Array) -> "CornerTerm":
        """The corners of views in order, with the camera held."""
        view = np.repeat(np.arange(len(corners)), [len(c.board) for c in corners])
        board, rays, ids = (
            np.concatenate([getattr(c, name) for c in corners]) for name in ("board", "rays", "markers")
        )
        focal = np.array([camera.intrinsics.fx, camera.intrinsics.fy])
        return CornerTerm(view, board, rays, focal, sigma_px, ids >= 0)

    @cached_property
    def grown(self) -> Array:
        """[K, 2]: how corners move, pixels, where each side of their marker looks longer by a pixel."""
        return outward_motion(self.focal * self.rays, self.square)

    @cached_property
    def outwards(self) -> Array:
        """[K, 3]: the same on the board, metres for a metre."""
        return outward_motion(self.board, self.square)

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """Two rows a corner: each mode of a marker over its sigma, as one symmetric matrix, so that a row stays a corner's."""
        return self.white_rows(self.values(poses, shared))

    def values(self, poses: Array, shared: Shared) -> Array:
        """[K, 2, 1 + 6 + S] pixels: from where each corner was seen to where it should be, and the derivatives of that."""
        R, t = poses[self.view, :3, :3], poses[self.view, :3, 3]
        outwards = self.outwards
        p = np.einsum("kji,kj->ki", R, shared.print_scale * self.board + shared.growth_m * outwards - t)
        z = np.maximum(p[:, 2], 1e-3)
        at = p[:, :2] / z[:, None]
        by_point = np.concatenate([np.broadcast_to(np.eye(2), (len(p), 2, 2)), -at[..., None]], axis=2)
        by_point = by_point * (self.focal / z[:, None])[..., None]
        values = np.zeros((len(p), 2, 1 + POSE + SHARED))
        residual, by_pose, by_shared = values[..., 0], values[..., 1 : 1 + POSE], values[..., 1 + POSE :]
        residual[:] = self.focal * (at - self.rays) + shared.growth_px * self.grown
        by_pose[:] = np.concatenate([-by_point, by_point @ cross_matrix(p)], axis=2)  # p changes by -dt - dr x p
        by_shared[:, :, PRINT_SCALE] = np.einsum("kij,klj,kl->ki", by_point, R, self.board)
        by_shared[:, :, GROWTH_M] = np.einsum("kij,klj,kl->ki", by_point, R, outwards)
        by_shared[:, :, GROWTH_PX] = self.grown
        return values

    def white_rows(self, values: Array, shared: int = SHARED) -> Rows:
        """Rows of values [K, 2, 1 + N + S]: residual, N derivatives by what a view has, S by what is shared."""
        white = values / self.sigma_px[3]
        place, growth, shape = (part / sigma for part, sigma in zip(self.modes(values), self.sigma_px, strict=False))
        white[self.square] = (place + growth + shape).reshape(-1, *values.shape[1:])
        weight, cost = robust((white[..., 0] ** 2).sum(axis=1))
        flat, last = white.reshape(-1, white.shape[2]), white.shape[2] - shared
        view = np.repeat(self.view, 2)[:, None]
        return Rows(flat[:, 0], view, flat[:, None, 1:last], flat[:, last:], np.repeat(weight, 2), cost)

    def modes(self, values: Array) -> tuple[Array, Array, Array]:
        """(place, growth, shape), each [M, 4, 2, D]: orthogonal parts of values [K, 2, D] of the corners of M markers."""
        quads = values[self.square].reshape(-1, 4, 2, values.shape[2])
        growth = self.grown[self.square].reshape(-1, 4, 2)
        growth = growth - growth.mean(axis=1, keepdims=True)
        growth /= np.linalg.norm(growth, axis=(1, 2), keepdims=True)
        place = np.broadcast_to(quads.mean(axis=1, keepdims=True), quads.shape)
        grown = np.einsum("mij,mijd->md", growth, quads)[:, None, None] * growth[..., None]
        return place, grown, quads - place - grown

    def measured(self, rows: Rows, spec: Estimation) -> "CornerTerm":
        """The term with sigma_px as its residuals have it.

        The variance of each mode is its median square over that of chi-square, over the share of its coordinates that
        what a view has of its own leaves (restricted maximum likelihood; the median resists what hides markers).
        """
        sigma_px, by_view = self.sigma_px.copy(), rows.by_view[:, 0] * np.sqrt(rows.weight)[:, None]
        taken = np.einsum("nj,njk->nk", by_view, pose_halves(rows, int(self.view.max()) + 1)[rows.view[:, 0]])
        values = np.concatenate([rows.residual[:, None], taken], axis=1).reshape(len(self.board), 2, -1)
        parts = [*self.modes(values), values[~self.square][:, None]]
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
            of_view = residual[np.repeat(self.view == number, 2)]
            if len(of_view) > POSE:
                ratio[number] = (MAD * float(np.median(of_view))) ** 2 * len(of_view) / (len(of_view) - POSE)
        return np.maximum(ratio, 1.0)


def outward_motion(corners: Array, square: NDArray[np.bool_]) -> Array:
    """[K, D]: how corners [K, D] of quads, of which each is in a plane, move where each side of a quad gets longer by 1.

    Each edge moves outwards by a half, along its normal; a corner stays where its two edges meet. square [K]: as in CornerTerm.
    """
    quads = corners[square].reshape(-1, 4, corners.shape[1])
    along = np.roll(quads, -1, axis=1) - quads
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    before = np.roll(along, 1, axis=1)
    # n1 d = n2 d = 1/2 with normals across the unit directions a and b: d = (a - b) / (2 |a x b|), outwards for either sense.
    sine = np.sqrt(1.0 - (before * along).sum(axis=2, keepdims=True) ** 2)
    motion = np.zeros_like(corners)
    motion[square] = ((before - along) / (2.0 * sine)).reshape(-1, corners.shape[1])
    return motion
