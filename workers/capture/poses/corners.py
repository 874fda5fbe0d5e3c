"""Corners of all views: their rows, the noise of each mode of a marker, and what corners say of the shutter and the camera."""

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
from workers.capture.poses.observation import Corners
from workers.capture.poses.terms import (
    CAMERA,
    GROW_M,
    GROW_PX,
    GROWTH_M,
    GROWTH_PX,
    MAD,
    POSE,
    PRINT_SCALE,
    SHARED,
    SIGNIFICANT,
    Problem,
    Rows,
    Shared,
    Solution,
    cross_matrix,
    median_of_chi_square,
    minimise,
    motion_between,
    pose_halves,
    robust,
)
from workers.geometry.pixels import rays_of_pixels

MODES = (2, 1, 5)
"""How many of the eight coordinates of a marker's corners are its place, the growth of its sides, and the rest: its shape."""
FLOOR_PX = 0.02
"""No corner is taken to be better than this."""
PRIOR_RESIDUALS = 2
"""The expected sigma of a corner counts as much as so many measured residuals."""
MATERIAL = 5e-4
"""What moves a pose by more than this share of its distance is told: a calibration is no better."""
LEVEL = 1e-3
"""Level of the F tests by which markers ask for another camera than camera.json's: one capture in a thousand is wronged."""
SWEPT = 0.005
"""Sigma of the motion of a hand while an image is read, metres and radians: 0.15 m/s and 9 degrees/s for 1/30 s. A step across
the rows and a turn that undoes it look alike on a board: of the two, the markers tell only the sum."""
EXPLAINED = 0.2
"""Motion that explains a smaller share of the misfit is no finding: noise of a lens or of hidden markers is alike nearby."""


@dataclass(frozen=True, eq=False)
class Doubt:
    """What the poses may need: motion [V, 6] with its covariance [V, 6, 6], and why in words; empty where it is too little."""

    motion: Array
    covariance: Array
    note: str


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
    With `seen` (their pixels [K, 2], centres at +0.5, and the camera of the rays) its intrinsics can be estimated as well.
    """

    view: NDArray[np.int64]
    board: Array
    rays: Array
    focal: Array
    sigma_px: Array
    square: NDArray[np.bool_]
    seen: tuple[Array, CaptureCamera] | None = None

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
        R, t = poses[self.view, :3, :3], poses[self.view, :3, 3]
        outwards = self.outwards
        p = np.einsum("kji,kj->ki", R, shared.print_scale * self.board + shared.growth_m * outwards - t)
        z = np.maximum(p[:, 2], 1e-3)
        at = p[:, :2] / z[:, None]
        rays, by_camera = self._rays(shared)
        focal = self.focal * (1.0 + np.array(shared.camera[:2]))  # else a longer one would make noise smaller
        by_point = np.concatenate([np.broadcast_to(np.eye(2), (len(p), 2, 2)), -at[..., None]], axis=2)
        by_point = by_point * (focal / z[:, None])[..., None]
        values = np.zeros((len(p), 2, 1 + POSE + SHARED))
        residual, by_pose, by_shared = values[..., 0], values[..., 1 : 1 + POSE], values[..., 1 + POSE :]
        residual[:] = focal * (at - rays) + shared.growth_px * self.grown
        by_pose[:] = np.concatenate([-by_point, by_point @ cross_matrix(p)], axis=2)  # p changes by -dt - dr x p
        by_shared[:, :, PRINT_SCALE] = np.einsum("kij,klj,kl->ki", by_point, R, self.board)
        by_shared[:, :, GROWTH_M] = np.einsum("kij,klj,kl->ki", by_point, R, outwards)
        by_shared[:, :, GROWTH_PX] = self.grown
        by_shared[:, :, CAMERA] = -focal[:, None] * by_camera
        by_shared[:, :, CAMERA][:, [0, 1], [0, 1]] += self.focal * (at - rays)
        white = values / self.sigma_px[3]
        place, growth, shape = (part / sigma for part, sigma in zip(self.modes(values), self.sigma_px, strict=False))
        white[self.square] = (place + growth + shape).reshape(-1, *values.shape[1:])
        weight, cost = robust((white[..., 0] ** 2).sum(axis=1))
        flat = white.reshape(-1, white.shape[2])
        by_view = flat[:, None, 1 : 1 + POSE]
        return Rows(
            flat[:, 0], np.repeat(self.view, 2)[:, None], by_view, flat[:, 1 + POSE :], np.repeat(weight, 2), cost
        )

    def modes(self, values: Array) -> tuple[Array, Array, Array]:
        """(place, growth, shape), each [M, 4, 2, D]: orthogonal parts of values [K, 2, D] of the corners of M markers."""
        quads = values[self.square].reshape(-1, 4, 2, values.shape[2])
        growth = self.grown[self.square].reshape(-1, 4, 2)
        growth = growth - growth.mean(axis=1, keepdims=True)
        growth /= np.linalg.norm(growth, axis=(1, 2), keepdims=True)
        place = np.broadcast_to(quads.mean(axis=1, keepdims=True), quads.shape)
        grown = np.einsum("mij,mijd->md", growth, quads)[:, None, None] * growth[..., None]
        return place, grown, quads - place - grown

    def measured(self, poses: Array, shared: Shared, spec: Estimation) -> "CornerTerm":
        """The term with sigma_px as its residuals have it.

        The variance of each mode is its median square over that of chi-square, over the share of its coordinates that the
        poses leave (restricted maximum likelihood; the median resists what hides markers).
        """
        rows, sigma_px = self.rows(poses, shared), self.sigma_px.copy()
        by_pose = rows.by_view[:, 0] * np.sqrt(rows.weight)[:, None]
        taken = np.einsum("nj,njk->nk", by_pose, pose_halves(rows, len(poses))[rows.view[:, 0]])
        values = np.concatenate([rows.residual[:, None], taken], axis=1).reshape(-1, 2, 1 + POSE)
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


def find_rolling(term: CornerTerm, solution: Solution, height: int) -> Doubt | None:
    """What a rolling shutter does to each pose; None where corners do not ask for it, or it moves the poses by too little.

    Each view may have moved evenly from its first row to its last of `height`, which one step of Gauss and Newton finds
    beside its pose. All corners count alike: what rows do to markers is noise to their modes. An F test over all views.
    """
    poses = solution.poses
    rows = dataclasses.replace(term, sigma_px=np.full(4, term.sigma_px[0])).rows(poses, solution.shared)
    share, prior = np.repeat(term.focal[1] * term.rays[:, 1] / height, 2), np.diag(np.repeat([0.0, SWEPT**-2], POSE))
    motion, covariance, gain, left = np.zeros((len(poses), POSE)), np.zeros((len(poses), POSE, POSE)), 0.0, 0.0
    for number in range(len(poses)):
        J, residual, _ = rows.of_view(number)
        both = np.concatenate([J, share[rows.view[:, 0] == number, None] * J], axis=1)
        inverse = np.linalg.pinv(both.T @ both + prior, hermitian=True)
        step = -inverse @ (both.T @ residual)
        motion[number], covariance[number] = step[:POSE], inverse[:POSE, :POSE]
        gain, left = gain - float(step @ (both.T @ residual)), left + float(residual @ residual)
    degrees = POSE * len(poses), len(rows.residual) - 2 * POSE * len(poses)
    shift_m = np.linalg.norm(motion[:, :3], axis=1)
    if min(degrees) <= 0 or float(np.median(shift_m / np.linalg.norm(poses[:, :3, 3], axis=1))) < MATERIAL:
        return None
    variance = (left - gain) / degrees[1]
    if gain <= EXPLAINED * left or variance_ratio.sf(gain / (degrees[0] * variance), *degrees) >= LEVEL:
        return None
    note = (
        "the corners lie as if the camera moved while the rows of an image were read, which moves the poses by "
        f"{1000 * float(np.median(shift_m)):.1f} mm: hold it still for each photograph, or use a global shutter"
    )
    return Doubt(motion, variance * covariance, note)


# ---------------------------------------------------------------------------------------------- the camera

FREE = np.array([0.1, 0.1, 0.1, 0.1, 1.0])
"""Sigma of fx, fy, cx, cy (shares of the focal length) and k1 beforehand: wide, so that only what is not seen stays put."""
ALIKE_PX = 0.01
"""By so much markers may be displaced alike in all views, by what is printed beside them: no camera is blamed for it."""
WEAK = 1e-3
"""Of what one view tells of the camera, directions with less than this share of the strongest are left aside."""


FITS_NOT = (
    "camera.json does not fit: the markers say {numbers}, which moves the poses by {by}. Calibrate the camera at this size of "
    "image, or use --calibrate (estimation.calibrate), which takes what the markers say"
)
FITS_NO_MODEL = (
    "camera.json does not fit the markers, and no other focal length, principal point or k1 does: see that `distortion` has all "
    "numbers of the calibration (k4, k5, k6 too), or calibrate the camera at this size of image with a lens of eight numbers"
)
FITS_NONE = (
    "camera.json does not fit the markers, and the views are too few or too alike to say which of its numbers is wrong: "
    "calibrate the camera at this size of image, or take views from more sides"
)


UNEXPLAINED = 2.0
"""Where markers are off their place by more than so many times the noise of their shape, this camera does not explain it."""


@dataclass(frozen=True, eq=False)
class CameraFit(Doubt):
    """The camera by the markers of all views; significant: they ask for another than camera.json's.

    is_known: markers then lie where they should but for the noise of corners, and the poses are nearer to the truth with this
    camera, by its own uncertainty.
    """

    camera: CaptureCamera
    significant: bool
    is_known: bool


def corrected_camera(camera: CaptureCamera, numbers: Sequence[float] | Array) -> CaptureCamera:
    """The camera after the corrections (fx, fy, cx, cy, k1) of `Shared`."""
    k, (fx, fy, cx, cy, k1) = camera.intrinsics, (float(number) for number in numbers)
    update = {"fx": k.fx * (1 + fx), "fy": k.fy * (1 + fy), "cx": k.cx + k.fx * cx, "cy": k.cy + k.fy * cy}
    lens = frozen_array(camera.lens + k1 * np.eye(8)[0])
    return dataclasses.replace(camera, intrinsics=k.model_copy(update=update), lens=lens)


def fit_camera(
    held: CornerTerm, seen: tuple[Array, CaptureCamera], fixed: NDArray[np.bool_], begun: Solution, spec: Estimation
) -> CameraFit | None:
    """The camera by the corners of all views, begun at their poses; None where there are fewer corners than unknowns.

    An F test of the robust cost with and without another camera. What corners of one view have in common (blur, a bent board)
    looks like another camera: where the views' own gradients scatter by more than independent corners make them, that is the
    noise, with as many degrees of freedom as views and numbers have.
    """
    size, count = len(FREE), len(begun.poses)
    loose = np.zeros(count, bool)  # a pose that was given by hand is no measure of the camera
    prior = np.concatenate([np.zeros(GROWTH_M), [GROW_M, GROW_PX], FREE])
    corners, most = dataclasses.replace(held, seen=seen), spec.max_iterations
    free = minimise(Problem([corners], prior, loose), begun.poses, begun.shared, most)
    # A wrong camera makes corners look noisy: what is an outlier is known once it is right.
    corners = corners.measured(free.poses, free.shared, spec)
    free = minimise(Problem([corners], prior, loose), free.poses, free.shared, most)
    without, no_camera = dataclasses.replace(corners, seen=None), np.arange(SHARED) < CAMERA.start
    usual = minimise(Problem([without], prior * no_camera, loose), begun.poses, begun.shared, most)
    rows = corners.rows(free.poses, free.shared)
    degrees = len(rows.residual) - POSE * count - size - 2
    if degrees < size or count < 2:
        return None
    variance = rows.cost / degrees
    covariance = variance * free.covariance()
    alike = 0.25 * len(rows.residual) * (ALIKE_PX / corners.sigma_px[0]) ** 2  # two of a marker's eight are its place
    noise = size * variance * max(1.0, _scatter(rows, count, variance)) + alike
    ratio = (without.rows(usual.poses, usual.shared).cost - rows.cost) / noise
    significant = bool(variance_ratio.sf(ratio, size, size * (count - 1)) < LEVEL)
    motion = np.stack([motion_between(a, b) for a, b in zip(begun.poses, free.poses, strict=True)])
    motion[fixed] = 0.0
    of_camera, by_camera = covariance[-size:, -size:], covariance[:-SHARED, -size:].reshape(count, POSE, size)
    of_poses = np.einsum("vij,jk,vlk->vil", by_camera, np.linalg.inv(of_camera), by_camera)
    shift_m, unsure_m = np.linalg.norm(motion[:, :3], axis=1), np.sqrt(np.trace(of_poses[:, :3, :3], axis1=1, axis2=2))
    camera, note = corrected_camera(seen[1], free.shared.camera), ""
    explains = bool(corners.sigma_px[0] <= UNEXPLAINED * corners.sigma_px[2])
    sure = np.abs(free.shared.camera) > SIGNIFICANT * np.sqrt(np.diag(of_camera))
    numbers = compare_cameras(camera, seen[1], sure)
    material = float(np.max(shift_m / np.linalg.norm(begun.poses[:, :3, 3], axis=1))) >= MATERIAL
    if significant and not explains:
        note = FITS_NO_MODEL * material
    elif significant and (material or (numbers and explains)):
        by = f"{1000 * float(np.median(shift_m)):.1f} mm"
        note = FITS_NOT.format(numbers=numbers, by=by) if numbers else FITS_NONE
    is_known = significant and explains and bool(np.median(shift_m) > np.median(unsure_m))
    return CameraFit(motion, of_poses, note, camera, significant, is_known)


def _scatter(rows: Rows, views: int, variance: float) -> float:
    """Mean, over the views, of what their gradients by the camera come to over what independent corners make them."""
    ratios = []
    for number in range(views):
        J, residual, by = rows.of_view(number)
        if len(J) <= POSE:
            continue
        by = by[:, CAMERA] - J @ np.linalg.pinv(J.T @ J, hermitian=True) @ (
            J.T @ by[:, CAMERA]
        )  # what no pose takes up
        strength, directions = np.linalg.eigh(by.T @ by)
        kept = strength > WEAK * strength[-1]
        along = directions[:, kept].T @ (by.T @ residual)
        ratios.append(float((along**2 / strength[kept]).mean()) / variance)
    return float(np.mean(ratios)) if ratios else 1.0


def compare_cameras(camera: CaptureCamera, given: CaptureCamera, chosen: NDArray[np.bool_] | None = None) -> str:
    """Numbers of two cameras in words, as camera.json has them with pixel_centre 0: all five, or those chosen."""
    k, of = camera.intrinsics, given.intrinsics
    pairs = [(k.fx, of.fx), (k.fy, of.fy), (k.cx_opencv, of.cx_opencv), (k.cy_opencv, of.cy_opencv)]
    words = [f"{name} = {a:.1f} ({b:.1f} given)" for name, (a, b) in zip(("fx", "fy", "cx", "cy"), pairs, strict=True)]
    words.append(f"k1 = {camera.lens[0]:.4f} ({given.lens[0]:.4f} given)")
    return ", ".join(word for n, word in enumerate(words) if chosen is None or chosen[n])
