"""Why the corners of all views do not lie where their poses put them: the explanations, compared on the same residuals.

Each explanation moves corners in the image along known directions, its fields, by numbers that all views share or that each
view has of its own; these are fitted beside the poses. What fits is told by Schwarz's criterion (1978): twice the gain in log
likelihood against the number of parameters. The noise is what a smooth free field in each view leaves, whatever bends the
corners (the pure error of a test for lack of fit); an explanation that leaves much more than that does not explain.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.capture import CaptureCamera
from schemas.job.captures import Estimation
from workers.capture.poses.corners import LOOSE, CornerTerm, Fields, Fitted, fit_fields, measure_noise
from workers.capture.poses.observation import Patches
from workers.capture.poses.terms import (
    POSE,
    SHARED,
    SIGNIFICANT,
    Shared,
    Solution,
    motion_between,
)
from workers.geometry.pixels import project_points, rays_of_pixels

MATERIAL = 5e-4
"""What turns a pose by more radians, or moves it by more than this share of its distance, is told: no calibration is better."""
ALIKE_PX = 0.01
"""By so much markers may be displaced alike in all views, by what is printed beside them: no explanation is believed for it."""
FITS = 1.5
"""An explanation leaves at most so many times the noise of a corner; else something else bends them."""
EXPLAINED = 0.03
"""What explains a smaller share of the misfit by each number of a view is no finding: noise of a lens or of hidden markers is
alike nearby."""
SWEPT = 0.005
"""Sigma of the motion of a hand while an image is read, metres and radians: 0.15 m/s and 9 degrees/s for 1/30 s. A step across
the rows and a turn that undoes it look alike on a board: of the two, the markers tell only the sum."""


# ---------------------------------------------------------------------------------------------- the explanations


@dataclass(frozen=True, eq=False)
class Seen:
    """What explanations are made of: the corners at the poses to begin with, their pixels [K, 2], and the camera."""

    term: CornerTerm
    poses: Array
    shared: Shared
    pixels: Array
    camera: CaptureCamera

    def rays_by(self, camera: CaptureCamera) -> Array:
        """[K, 2]: the corners' rays as another camera has them; nan where it has none."""
        return rays_of_pixels(self.pixels, camera.intrinsics, camera.lens)

    def without_lens(self) -> "Seen":
        """Read by a pinhole: of another lens some corners have no ray, and those near its edge hold it fast."""
        camera = dataclasses.replace(self.camera, lens=frozen_array(np.zeros(8)))
        return dataclasses.replace(self, term=dataclasses.replace(self.term, rays=self.rays_by(camera)), camera=camera)

    def expected(self) -> "Seen":
        """With pixels where corners should be: numbers that scale what was measured would fit by making its noise smaller."""
        return dataclasses.replace(self, pixels=self.pixels + self.term.values(self.poses, self.shared)[..., 0])

    def by_pose(self) -> Array:
        """[K, 2, 6]: how corners move by a motion of their camera."""
        return self.term.values(self.poses, self.shared)[..., 1 : 1 + POSE]

    def by_board(self, motion: Array) -> Array:
        """[K, 2, M]: how corners move where their places on the board do, by motion [K, 3, M] metres."""
        R = self.poses[self.term.view, :3, :3]
        return np.asarray(-self.by_pose()[..., :3] @ (R.swapaxes(1, 2) @ motion))


CENTRE, PINHOLE, BENT, WHOLE = (2, 3), (0, 1, 2, 3), (0, 1, 2, 3, 4), tuple(range(12))
"""Which numbers of a camera are free: of fx, fy, cx, cy, shares of its focal length, and the eight of its lens."""
DIFFERENCE = 1e-5
"""Step of the numbers of a camera by which rays are differentiated: rays are exact to 1e-11."""


def _numbers(seen: Seen, chosen: tuple[int, ...]) -> Fields:
    """By those numbers of the camera; where a step leaves a corner without a ray, it is not moved."""
    columns, expected = [], seen.expected()
    for n in chosen:
        rays = [
            expected.rays_by(changed_camera(seen.camera, (n,), np.array([step]))) for step in (DIFFERENCE, -DIFFERENCE)
        ]
        columns.append(np.nan_to_num(-seen.term.focal * (rays[0] - rays[1]) / (2 * DIFFERENCE)))
    return Fields.of(np.stack(columns, axis=2), sigma=np.where(np.array(chosen) < len(PINHOLE), LOOSE, 1.0))


def changed_camera(camera: CaptureCamera, chosen: tuple[int, ...], by: Array) -> CaptureCamera:
    """The camera after corrections of those of its numbers, as `WHOLE` has them."""
    k, numbers = camera.intrinsics, np.zeros(len(WHOLE))
    numbers[list(chosen)] = by
    fx, fy, cx, cy = numbers[:4].tolist()
    update = {"fx": k.fx * (1 + fx), "fy": k.fy * (1 + fy), "cx": k.cx + k.fx * cx, "cy": k.cy + k.fy * cy}
    return dataclasses.replace(
        camera, intrinsics=k.model_copy(update=update), lens=frozen_array(camera.lens + numbers[4:])
    )


FOCUS = 0.005
"""Sigma of the focal length from view to view, a share: autofocus and stabilisation change it by about so much."""


def _focus(seen: Seen) -> Fields:
    expected = seen.term.focal * seen.term.rays + seen.term.values(seen.poses, seen.shared)[..., 0]
    return Fields.of(None, expected[..., None], FOCUS)


def _rolling(seen: Seen) -> Fields:
    share = seen.pixels[:, 1] / seen.camera.intrinsics.height - 0.5
    return Fields.of(None, share[:, None, None] * seen.by_pose(), sigma=SWEPT)


def _bent(seen: Seen) -> Fields:
    """A plane board that sags: z by x^2, x y and y^2, each so many metres at a metre."""
    x, y, _ = seen.term.board.T
    up = np.zeros((len(x), 3, 3))
    up[:, 2] = np.stack([x * x, x * y, y * y], axis=1)
    return Fields.of(seen.by_board(up), sigma=1.0)


def _stretched(seen: Seen) -> Fields:
    """A print that is longer along x than along y, and leans."""
    along = np.zeros((len(seen.pixels), 3, 2))
    along[:, 0] = seen.term.board[:, :2]
    return Fields.of(seen.by_board(along))


@dataclass(frozen=True)
class Explanation:
    """One way in which corners come to lie elsewhere: its fields, its words, and which numbers of the camera it frees."""

    name: str
    fields: Callable[[Seen], Fields]
    words: str
    numbers: tuple[int, ...] = ()


CAMERA_FITS_NOT = (
    "camera.json does not fit: the markers say {numbers}, which moves the poses by {by}. {half}Calibrate the camera at this size "
    "of image{take}"
)
TAKE = ", or use --calibrate (estimation.calibrate), which takes what the markers say"
"""Said of a camera that is known so well that it brings the poses nearer to the truth."""
LENS = (
    "camera.json does not fit the markers, and no other focal length, principal point or k1 does, but another lens, which moves "
    "the poses by {by}: see that `distortion` has all numbers of the calibration (k4, k5, k6 too) and that it is no fisheye, or "
    "calibrate the camera at this size of image with a lens of eight numbers"
)
EXPLANATIONS = (
    Explanation("none", lambda seen: Fields.of(np.zeros((len(seen.pixels), 2, 0))), ""),
    Explanation("centre", lambda seen: _numbers(seen, CENTRE), CAMERA_FITS_NOT, CENTRE),
    Explanation("camera", lambda seen: _numbers(seen, PINHOLE), CAMERA_FITS_NOT, PINHOLE),
    Explanation("lens k1", lambda seen: _numbers(seen, BENT), CAMERA_FITS_NOT, BENT),
    Explanation("lens", lambda seen: _numbers(seen, WHOLE), LENS, WHOLE),
    Explanation(
        "focus",
        _focus,
        "the focal length changes from view to view by {spread:.1%}, which moves the poses by {by}: switch autofocus and "
        "stabilisation off, or give each view its camera_00000.json",
    ),
    Explanation(
        "rolling shutter",
        _rolling,
        "the corners lie as if the camera moved while the rows of an image were read, which moves the poses by {by}: "
        "hold it still for each photograph, or use a global shutter",
    ),
    Explanation(
        "bent board",
        _bent,
        "the board is bent by {sag:.1f} mm, which moves the poses by {by}: glue the print to a flat, stiff plate",
    ),
    Explanation(
        "stretched print",
        _stretched,
        "the print is {stretch:.2%} longer along x than along y, which moves the poses by {by}: print without "
        "scaling to the page, or describe the markers one by one in board.json",
    ),
)
NONE_FITS = (
    "the corners lie {off:.2f} px off, {times:.0f} times their noise, and no explanation fits (camera.json, its lens, focus, "
    "rolling shutter, a bent or stretched print): the nearest is {name}, which leaves {left:.2f} px. Calibrate the camera at "
    "this size of image, and look at the print"
)
ALIKE_VIEWS = (
    "camera.json does not fit the markers, and the views are too few or too alike to say which of its numbers is wrong: "
    "calibrate the camera at this size of image, or take views from more sides"
)
HALF = "Both are half a pixel off: is pixel_centre right? "


@dataclass(frozen=True, eq=False)
class Doubt:
    """What the poses may need: motion [V, 6] to the poses [V, 4, 4] that explain the corners, with its covariance [V, 6, 6].

    Why, in words, empty where it is too little; whether it leaves no more than the noise; the camera that explains the corners,
    and whether it is so well known that it brings the poses nearer to the truth.
    """

    poses: Array
    motion: Array
    covariance: Array
    note: str
    fits: bool
    camera: CaptureCamera
    is_known: bool

    def reread(self, patches: Patches, given: CaptureCamera) -> Patches:
        """Patches of depth where the camera of this explanation has them."""
        if self.camera == given or not len(patches):
            return patches
        pixels = project_points(patches.ray, given.intrinsics, given.lens)
        rays = rays_of_pixels(pixels, self.camera.intrinsics, self.camera.lens)
        rays = np.where(np.isfinite(rays), rays, patches.ray[:, :2])
        ray = np.column_stack([rays, np.ones(len(rays))])
        return dataclasses.replace(patches, ray_z=ray * patches.ray_z[:, 2:], ray=ray)


@dataclass(frozen=True, eq=False)
class _Tried:
    """An explanation as it fits, and the corners as its camera reads them."""

    explanation: Explanation
    seen: Seen
    fitted: Fitted


ROUNDS, SAME = 5, 0.1
"""How often the noise is measured anew about the best explanation, until it is the same to a tenth: what a smooth field leaves
of a strong bend is no noise."""


def find_doubt(
    term: CornerTerm, seen: tuple[Array, CaptureCamera], fixed: NDArray[np.bool_], begun: Solution, spec: Estimation
) -> Doubt | None:
    """The explanation that fits the corners best, begun at their poses; None where it is that nothing is wrong.

    seen: pixels [K, 2] of the corners, centres at +0.5, and camera.json's; fixed [V]: poses given by hand, which do not move.
    With `calibrate` the camera is of this capture's own markers, and what they do not tell of it is in the covariance.
    """
    start = Seen(term, begun.poses, begun.shared, *seen)
    count, about, before, variance = 2 * len(term.board), start, np.full(4, np.inf), 1.0
    best = usual = _try(EXPLANATIONS[0], start)
    for _ in range(ROUNDS):
        sigma_px, left = measure_noise(about.term, about.poses, about.shared, spec)
        if left is None or len(begun.poses) < 2:
            return None
        if np.allclose(sigma_px, before, rtol=SAME):
            break
        start, about = (
            dataclasses.replace(s, term=dataclasses.replace(s.term, sigma_px=sigma_px)) for s in (start, about)
        )
        begin = {WHOLE: start.without_lens(), best.explanation.numbers: about, (): start}
        tried = [_try(explanation, begin.get(explanation.numbers, start)) for explanation in EXPLANATIONS]
        before, variance, usual = sigma_px, left, tried[0]
        best = min(tried, key=lambda t: t.fitted.cost / variance + t.fitted.occam + len(t.fitted.alike) * np.log(count))
        if best is usual:
            break
        about = dataclasses.replace(best.seen, poses=best.fitted.poses, shared=best.fitted.shared)
    # What fewer numbers say is sure only where more numbers leave it so: views that are alike tell none from another.
    bent = next(t for t in tried if t.explanation.numbers == BENT)
    wide = bent if 0 < len(best.explanation.numbers) < len(BENT) else best
    if best is usual and spec.calibrate:
        covariance = max(variance, 1.0) * next(t for t in tried if t.explanation.numbers == WHOLE).fitted.covariance
        return Doubt(start.poses, np.zeros((len(start.poses), POSE)), covariance, "", True, start.camera, False)
    gain = usual.fitted.cost - best.fitted.cost
    alike = 0.25 * count * (ALIKE_PX / start.term.sigma_px[0]) ** 2  # two of a marker's eight are its place
    wanted = EXPLAINED * best.fitted.own.shape[1] * usual.fitted.cost
    if best.fitted.alike.size:
        wanted = len(best.fitted.alike) * np.log(count) * variance * max(1.0, _scatter(best, variance)) + alike
    return None if best is usual or gain < wanted else _doubt(best, wide, usual, start, fixed, variance, spec)


CAMERAS = 6
"""How often a camera is fitted anew about the one before."""


def _try(explanation: Explanation, start: Seen) -> _Tried:
    """The explanation at its least cost; one of the camera is fitted anew about the camera that it says."""
    seen = start
    fitted = fit_fields(seen.term, explanation.fields(seen), seen.poses, seen.shared)
    for _ in range(CAMERAS if explanation.numbers else 0):
        before, camera = fitted.cost, changed_camera(seen.camera, explanation.numbers, fitted.alike)
        rays = seen.rays_by(camera)
        if not np.isfinite(rays).all():
            break
        k = camera.intrinsics
        term = dataclasses.replace(seen.term, rays=rays, focal=np.array([k.fx, k.fy]))
        seen = dataclasses.replace(seen, term=term, poses=fitted.poses, shared=fitted.shared, camera=camera)
        fitted = fit_fields(seen.term, explanation.fields(seen), seen.poses, seen.shared)
        if abs(fitted.cost - before) < 1e-3 * before:
            break
    return _Tried(explanation, seen, fitted)


def _scatter(tried: _Tried, variance: float) -> float:
    """Mean, over the views, of what their gradients by the shared numbers come to over what independent corners make them."""
    ratios, rows = [], tried.fitted.rows
    for number in range(len(tried.seen.poses)):
        J, residual, by = rows.of_view(number)
        if len(J) <= J.shape[1]:
            continue
        by = by[:, SHARED:]
        by = by - J @ np.linalg.pinv(J.T @ J, hermitian=True) @ (J.T @ by)  # what no pose takes up
        strength, directions = np.linalg.eigh(by.T @ by)
        kept = strength > WEAK * strength[-1]
        along = directions[:, kept].T @ (by.T @ residual)
        ratios.append(float((along**2 / strength[kept]).mean()) / variance)
    return float(np.mean(ratios)) if ratios else 1.0


WEAK = 1e-3
"""Of what one view tells of shared numbers, directions with less than this share of the strongest are left aside."""


def _doubt(
    best: _Tried, wide: _Tried, usual: _Tried, start: Seen, fixed: NDArray[np.bool_], variance: float, spec: Estimation
) -> Doubt:
    """The best explanation, its words, and whether its camera is known; variance: of rows that have no more than noise."""
    fitted, explanation = best.fitted, best.explanation
    motion = np.stack([motion_between(a, b) for a, b in zip(start.poses, fitted.poses, strict=True)])
    motion[fixed] = 0.0
    noise = variance * len(fitted.rows.residual)
    shift_m, turn = (np.linalg.norm(motion[:, part], axis=1) for part in (slice(3), slice(3, 6)))
    unsure_m = np.sqrt(variance * np.trace(wide.fitted.covariance[:, :3, :3], axis1=1, axis2=2))
    off, left = (float(np.sqrt(tried.fitted.cost / noise)) for tried in (usual, best))
    fits = left <= FITS
    sure = best is not usual and bool(np.median(shift_m) > np.median(unsure_m))
    is_known = fits and sure and bool(explanation.numbers) and (explanation.numbers != WHOLE or spec.calibrate)
    shift = np.median(shift_m / np.linalg.norm(start.poses[:, :3, 3], axis=1))
    material = bool(max(shift, np.median(turn)) >= MATERIAL)
    note, px = "", float(start.term.sigma_px[0])
    if fits:
        by = f"{1000 * np.median(shift_m):.1f} mm, {np.degrees(np.median(turn)):.2f} degrees"
        note = _words(best, wide, start, variance, by, is_known, material)
    elif material:
        note = NONE_FITS.format(off=px * off, times=off, name=explanation.name, left=px * left)
    camera = best.seen.camera if explanation.numbers else start.camera
    return Doubt(fitted.poses, motion, max(variance, 1.0) * fitted.covariance, note, fits, camera, is_known)


def _words(best: _Tried, wide: _Tried, start: Seen, variance: float, by: str, is_known: bool, material: bool) -> str:
    """What an explanation that fits says; by: how far it moves the poses. Numbers of a camera are said however little that is."""
    fitted, numbers, words = best.fitted, best.explanation.numbers, best.explanation.words
    if numbers in ((), WHOLE):
        of_view = np.abs(fitted.own - np.median(fitted.own)) if fitted.own.size else np.zeros(1)
        alike = fitted.alike if len(fitted.alike) else np.zeros(1)
        reach_m = 0.5 * np.ptp(start.term.board, axis=0).max()
        sag, stretch = 1000 * np.abs(alike).max() * reach_m**2, alike[0]
        return words.format(by=by, spread=of_view.max(), sag=sag, stretch=stretch) if material else ""
    k, of = best.seen.camera.intrinsics, start.camera.intrinsics
    change = np.array([k.fx / of.fx - 1, k.fy / of.fy - 1, (k.cx - of.cx) / of.fx, (k.cy - of.cy) / of.fy])
    index, sigma = [n for n in numbers if n < len(PINHOLE)], np.sqrt(variance * np.diag(wide.fitted.alike_covariance))
    sure = np.append(np.zeros(len(PINHOLE), np.bool_), len(numbers) > len(PINHOLE))
    sure[index] = np.abs(change[index]) > SIGNIFICANT * sigma[index]
    sure[:2] = sure[:2].any()
    if not sure.any():
        return ALIKE_VIEWS if material else ""
    shift = np.array([k.cx - of.cx, k.cy - of.cy])
    half = HALF if (np.abs(np.abs(shift) - 0.5) < 0.15).all() and shift.prod() > 0 else ""
    said = compare_cameras(best.seen.camera, start.camera, sure)
    return words.format(numbers=said, by=by, half=half, take=TAKE if is_known else "")


def compare_cameras(camera: CaptureCamera, given: CaptureCamera, chosen: NDArray[np.bool_] | None = None) -> str:
    """Numbers of two cameras in words, as camera.json has them with pixel_centre 0: all five, or those chosen."""
    k, of = camera.intrinsics, given.intrinsics
    pairs = [(k.fx, of.fx), (k.fy, of.fy), (k.cx_opencv, of.cx_opencv), (k.cy_opencv, of.cy_opencv)]
    words = [f"{name} = {a:.1f} ({b:.1f} given)" for name, (a, b) in zip(("fx", "fy", "cx", "cy"), pairs, strict=True)]
    words.append(f"k1 = {camera.lens[0]:.4f} ({given.lens[0]:.4f} given)")
    return ", ".join(word for n, word in enumerate(words) if chosen is None or chosen[n])
