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
    GROW_M,
    GROW_PX,
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
    moved,
    pose_halves,
    robust,
)
from workers.geometry.frames import add_up

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
        board, outwards, place = (np.einsum("kji,kj->ki", R, part) for part in (self.board, self.outwards, t))
        p = shared.print_scale * board + shared.growth_m * outwards - place
        z = np.maximum(p[:, 2], 1e-3)
        at = p[:, :2] / z[:, None]
        by_point = np.concatenate([np.broadcast_to(np.eye(2), (len(p), 2, 2)), -at[..., None]], axis=2)
        by_point = by_point * (self.focal / z[:, None])[..., None]
        values = np.zeros((len(p), 2, 1 + POSE + SHARED))
        residual, by_pose, by_shared = values[..., 0], values[..., 1 : 1 + POSE], values[..., 1 + POSE :]
        residual[:] = self.focal * (at - self.rays) + shared.growth_px * self.grown
        by_pose[:] = np.concatenate([-by_point, by_point @ cross_matrix(p)], axis=2)  # p changes by -dt - dr x p
        by_shared[:, :, PRINT_SCALE] = np.einsum("kij,kj->ki", by_point, board)
        by_shared[:, :, GROWTH_M] = np.einsum("kij,kj->ki", by_point, outwards)
        by_shared[:, :, GROWTH_PX] = self.grown
        return values

    def white_rows(self, values: Array, shared: int = SHARED) -> Rows:
        """Rows of values [K, 2, 1 + N + S]: residual, N derivatives by what a view has, S by what is shared."""
        white = values / self.sigma_px[3]
        quads = values[self.square].reshape(-1, 8, values.shape[2])
        white[self.square] = (self.whitening @ quads).reshape(-1, *values.shape[1:])
        weight, cost = robust((white[..., 0] ** 2).sum(axis=1))
        flat, last = white.reshape(-1, white.shape[2]), white.shape[2] - shared
        view = np.repeat(self.view, 2)[:, None]
        return Rows(flat[:, 0], view, flat[:, None, 1:last], flat[:, last:], np.repeat(weight, 2), cost)

    @cached_property
    def whitening(self) -> Array:
        """[M, 8, 8]: of the eight coordinates of each marker, the parts of each mode over its sigma."""
        unit = np.zeros((len(self.board), 2, 8))
        unit[self.square] = np.tile(np.eye(8).reshape(4, 2, 8), (int(self.square.sum()) // 4, 1, 1))
        place, growth, shape = (part / sigma for part, sigma in zip(self.modes(unit), self.sigma_px, strict=False))
        return (place + growth + shape).reshape(-1, 8, 8)

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
        taken = np.empty_like(by_view)
        for number, half in enumerate(pose_halves(rows, int(self.view.max()) + 1)):
            chosen = rows.view[:, 0] == number
            taken[chosen] = by_view[chosen] @ half
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


# ---------------------------------------------------------------------------------------------- what displaces corners

LOOSE = 0.1
"""Sigma of numbers of a camera, shares of its focal length, and of a stretch: wide, so that only what is not seen stays."""
STEPS, NOISE_STEPS, SETTLED, REGULAR, HELD = 8, 3, 1e-6, 1e-2, 1e12


@dataclass(frozen=True, eq=False)
class Fields:
    """How corners [K] move in the image, pixels, by each number of an explanation.

    alike [K, 2, A]: by those that all views share; of_view [K, 2, N]: by those that each view has of its own; sigma [A + N]: of
    each number beforehand.
    """

    alike: Array
    of_view: Array
    sigma: Array

    @staticmethod
    def of(alike: Array | None, of_view: Array | None = None, sigma: float | Array = LOOSE) -> "Fields":
        """Of either kind or both."""
        some = alike if alike is not None else of_view
        assert some is not None
        none = np.zeros((*some.shape[:2], 0))
        alike, of_view = none if alike is None else alike, none if of_view is None else of_view
        return Fields(alike, of_view, np.broadcast_to(sigma, alike.shape[2] + of_view.shape[2]))


@dataclass(frozen=True, eq=False)
class Fitted:
    """An explanation at its least cost: poses [V, 4, 4], growth of squares, its numbers, and the rows there.

    covariance [V, 6, 6] of the poses and alike_covariance [A, A], where rows have unit variance. `occam`: what the numbers of
    the views cost by Laplace's approximation of the evidence: their squares, and how much narrower they are than beforehand.
    """

    poses: Array
    shared: Shared
    alike: Array
    own: Array
    rows: Rows
    covariance: Array
    alike_covariance: Array
    occam: float

    @property
    def cost(self) -> float:
        """Robust sum of squares, in sigma of a corner squared."""
        return self.rows.cost


def fit_fields(
    term: CornerTerm, fields: Fields, poses: Array, shared: Shared, hold: float = 0.0, steps: int = STEPS
) -> Fitted:
    """The poses and numbers of least robust cost, by Gauss and Newton, each view's own unknowns eliminated in turn.

    hold: by how much a pose resists, where a view's fields can do all that it does, which takes few steps.
    """
    views, (A, N) = len(poses), (fields.alike.shape[2], fields.of_view.shape[2])
    alike, own = np.zeros(A), np.zeros((views, N))
    prior = np.concatenate([[GROW_M, GROW_PX], fields.sigma[:A]]) ** -2.0
    own_prior = np.concatenate([np.full(POSE, hold), fields.sigma[A:] ** -2.0])
    best: Fitted | None = None
    P, rows_of = POSE + N, [np.repeat(term.view == number, 2) for number in range(views)]
    for _ in range(steps):
        values = term.values(poses, shared)
        values[..., 0] += fields.alike @ alike + np.einsum("kcn,kn->kc", fields.of_view, own[term.view])
        order = (values[..., : 1 + POSE], fields.of_view, values[..., 1 + POSE :], fields.alike)
        rows = term.white_rows(np.concatenate(order, axis=2), SHARED + A)
        matrix, gradient = np.diag(prior), prior * np.concatenate([[shared.growth_m, shared.growth_px], alike])
        columns = np.column_stack([rows.by_view[:, 0], rows.by_shared[:, GROWTH_M:], rows.residual])
        columns *= np.sqrt(rows.weight)[:, None]
        parts = []
        for number, chosen in enumerate(rows_of):
            J = columns[chosen]
            product = J.T @ J
            of_own, cross, by = product[:P], product[P:-1, :P], product[P:-1]
            inverse = np.linalg.inv(of_own[:, :P] + np.diag(own_prior + REGULAR))
            g = of_own[:, -1] + own_prior * np.concatenate([np.zeros(POSE), own[number]])
            matrix = matrix + by[:, P:-1] - cross @ inverse @ cross.T
            gradient = gradient + by[:, -1] - cross @ inverse @ g
            parts.append((inverse, g, cross))
        covariance = np.linalg.pinv(matrix, hermitian=True)
        of_poses: Array = np.stack(
            [i[:POSE, :POSE] + (i @ c.T @ covariance @ c @ i)[:POSE, :POSE] for i, _, c in parts]
        )
        narrower = add_up(
            -np.linalg.slogdet(i[POSE:, POSE:])[1] + 2.0 * np.log(fields.sigma[A:]).sum() for i, _, _ in parts
        )
        occam = narrower + float((own**2 * own_prior[POSE:]).sum())
        now = Fitted(poses, shared, alike, own, rows, of_poses, np.asarray(covariance[2:, 2:], np.float64), occam)
        if best is None or now.cost < best.cost:
            best = now
        step = -covariance @ gradient
        of_views = np.stack([-i @ (g + c.T @ step) for i, g, c in parts])
        if max(np.abs(step).max(), np.abs(of_views).max()) < SETTLED:
            break
        poses, own, alike = moved(poses, of_views[:, :POSE]), own + of_views[:, POSE:], alike + step[2:]
        growth = shared.growth_m + float(step[0]), shared.growth_px + float(step[1])
        shared = dataclasses.replace(shared, growth_m=growth[0], growth_px=growth[1])
    assert best is not None
    return best


DEGREES = {24: 5, 18: 4, 14: 3, 0: 2}
"""The degree of the smooth field of a view by how many markers it has at least."""


def _smooth(term: CornerTerm, views: int) -> Fields:
    """A polynomial over the image in each view, whose degree is that which its markers bear."""
    view, rays = term.view, term.rays
    size = (max(DEGREES.values()) + 1) * (max(DEGREES.values()) + 2) // 2
    of_view = np.zeros((len(view), 2, 2 * size))
    for number in range(views):
        here = view == number
        if not here.any():
            continue
        p = rays[here] - rays[here].mean(axis=0)
        p = p / np.maximum(np.abs(p).max(axis=0), 1e-9)
        degree = next(d for markers, d in DEGREES.items() if here.sum() >= 4 * markers)
        powers = [p[:, 0] ** i * p[:, 1] ** (d - i) for d in range(degree + 1) for i in range(d + 1)]
        for n, power in enumerate(powers):
            of_view[here, 0, 2 * n] = of_view[here, 1, 2 * n + 1] = power
    return Fields.of(None, of_view, sigma=100.0)


def measure_noise(term: CornerTerm, poses: Array, shared: Shared, spec: Estimation) -> tuple[Array, float | None]:
    """(sigma_px [4] of what a smooth field in each view leaves of the corners, the variance left by it); None of too few."""
    fields = _smooth(term, len(poses))
    for _ in range(3):
        smooth = fit_fields(term, fields, poses, shared, HELD, NOISE_STEPS)
        before, term, shared = term, term.measured(smooth.rows, spec), smooth.shared
    columns = int((np.abs(fields.of_view).max(axis=(0, 1)) > 0).sum())
    count = len(smooth.rows.residual)
    free = count - columns * len(poses)
    variance = smooth.cost / free if free >= count // 4 else None
    sigma_px = before.sigma_px.copy()
    if (most := PLACE * sigma_px[2]) < sigma_px[0]:
        sigma_px[0], variance = most, variance and min(variance, 1.0)
    return sigma_px, variance


PLACE = 3.0
"""A marker's place is at most so many times noisier than its shape, which no camera bends much."""
