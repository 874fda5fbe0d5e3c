"""The camera by the markers of all views: whether they ask for another than camera.json's, and what they say instead."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as variance_ratio

from schemas.base import Array
from schemas.capture import CaptureCamera
from schemas.job.captures import Estimation
from workers.capture.poses.corners import LEVEL, corrected_camera
from workers.capture.poses.joint import Problem, Solution, Views, minimise
from workers.capture.poses.markers import MATERIAL, motion_between
from workers.capture.poses.terms import CAMERA, GROW_M, GROW_PX, GROWTH_M, POSE, SHARED, SIGNIFICANT, Rows

FREE = np.array([0.1, 0.1, 0.1, 0.1, 1.0])
"""Sigma of fx, fy, cx, cy (shares of the focal length) and k1 beforehand: wide, so that only what is not seen stays put."""
ALIKE_PX = 0.01
"""By so much markers may be displaced alike in all views, by what is printed beside them: no camera is blamed for it."""
WEAK = 1e-3
"""Of what one view tells of the camera, directions with less than this share of the strongest are left aside."""


@dataclass(frozen=True, eq=False)
class CameraFit:
    """What the markers of all views say of the camera.

    numbers [5]: corrections of fx, fy, cx, cy and k1 as in `Shared`, with their sigma [5]; motion [V, 6]: by how much the
    poses move with them; covariance [V, 6, 6]: of what they do to each pose; significant: whether the corners ask for another
    camera than camera.json's.
    """

    camera: CaptureCamera
    numbers: Array
    sigma: Array
    motion: Array
    covariance: Array
    significant: bool

    def shift_m(self) -> Array:
        """[V]: by how much each camera's place moves."""
        return np.linalg.norm(self.motion[:, :3], axis=1)

    def is_known(self) -> bool:
        """Whether the poses are nearer to the truth with this camera, by its own uncertainty."""
        unsure_m = np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2))
        return self.significant and bool(np.median(self.shift_m()) > np.median(unsure_m))


def fit_camera(views: Views, found: Solution, spec: Estimation) -> CameraFit | None:
    """The camera by the corners of all views, begun at their poses; None where there are fewer corners than unknowns.

    An F test of the robust cost with and without another camera. What corners of one view have in common (blur, a bent board)
    looks like another camera: where the views' own gradients scatter by more than independent corners make them, that is the
    noise, with as many degrees of freedom as views and numbers have.
    """
    corners, size, held_prior, prior = views.corner_term(), len(FREE), np.zeros(SHARED), np.zeros(SHARED)
    held_prior[GROWTH_M:] = [GROW_M, GROW_PX, *np.zeros(size)]
    prior[GROWTH_M:] = [GROW_M, GROW_PX, *FREE]
    pixels = np.concatenate([o.corners.pixels for o in views.observations])
    corners = dataclasses.replace(corners, seen=(pixels, views.camera))
    loose = np.zeros(len(views.poses), bool)  # a pose that was given by hand is no measure of the camera
    most = spec.max_iterations
    free = minimise(Problem([corners], prior, loose), found.poses, found.shared, most)
    # A wrong camera makes corners look noisy: what is an outlier is known once it is right.
    corners = corners.measured(free.poses, free.shared, spec)
    free = minimise(Problem([corners], prior, loose), free.poses, free.shared, most)
    without = dataclasses.replace(corners, seen=None)
    held = minimise(Problem([without], held_prior, loose), found.poses, found.shared, most)
    rows, count = corners.rows(free.poses, free.shared), len(views.poses)
    degrees = len(rows.residual) - POSE * count - size - 2
    if degrees < size or count < 2:
        return None
    variance = rows.cost / degrees
    covariance = variance * free.covariance()
    shared, numbers = covariance[-len(FREE) :, -len(FREE) :], np.array(free.shared.camera)
    alike = 0.25 * len(rows.residual) * (ALIKE_PX / corners.sigma_px[0]) ** 2  # two of a marker's eight are its place
    usual = size * variance * max(1.0, _scatter(rows, count, variance)) + alike
    ratio = (without.rows(held.poses, held.shared).cost - rows.cost) / usual
    motions = np.stack([motion_between(a, b) for a, b in zip(found.poses, free.poses, strict=True)])
    motions[views.fixed] = 0.0
    by_camera = covariance[:-SHARED, -len(FREE) :].reshape(count, POSE, size)
    return CameraFit(
        corrected_camera(views.camera, numbers),
        numbers,
        np.sqrt(np.diag(shared)),
        motions,
        np.einsum("vij,jk,vlk->vil", by_camera, np.linalg.inv(shared), by_camera),
        bool(variance_ratio.sf(ratio, size, size * (count - 1)) < LEVEL),
    )


def _scatter(rows: Rows, views: int, variance: float) -> float:
    """Mean, over the views, of what their gradients by the camera come to over what independent corners make them."""
    ratios = []
    for number in range(views):
        own = rows.first == number
        J, by, weight = rows.by_first[own], rows.by_shared[own][:, CAMERA], rows.weight[own][:, None]
        if len(J) <= POSE:
            continue
        # The view's own pose takes up what it can.
        by = by - J @ np.linalg.pinv((weight * J).T @ J, hermitian=True) @ ((weight * J).T @ by)
        strength, directions = np.linalg.eigh((weight * by).T @ by)
        kept = strength > WEAK * strength[-1]
        along = directions[:, kept].T @ ((weight * by).T @ rows.residual[own])
        ratios.append(float((along**2 / strength[kept]).mean()) / variance)
    return float(np.mean(ratios)) if ratios else 1.0


def camera_note(fitted: CameraFit, camera: CaptureCamera, poses: Array) -> str:
    """That camera.json does not fit, with what the markers say instead; empty where it hardly matters to any pose."""
    moved_by = fitted.shift_m()
    if float(np.max(moved_by / np.linalg.norm(poses[:, :3, 3], axis=1))) < MATERIAL:
        return ""
    sure = np.abs(fitted.numbers) > SIGNIFICANT * fitted.sigma
    if not sure.any():
        return (
            "camera.json does not fit the markers, and the views are too few or too alike to say which of its numbers is "
            "wrong: calibrate the camera at this size of image, or take views from more sides"
        )
    return (
        f"camera.json does not fit: the markers say {compare_cameras(fitted.camera, camera, sure)}, which moves the poses by "
        f"{1000 * float(np.median(moved_by)):.1f} mm. Calibrate the camera at this size of image, or use --calibrate "
        "(estimation.calibrate), which takes what the markers say"
    )


def compare_cameras(found: CaptureCamera, given: CaptureCamera, chosen: NDArray[np.bool_] | None = None) -> str:
    """Numbers of two cameras in words, as camera.json has them with pixel_centre 0: all five, or those chosen."""
    k, of = found.intrinsics, given.intrinsics
    pairs = [(k.fx, of.fx), (k.fy, of.fy), (k.cx_opencv, of.cx_opencv), (k.cy_opencv, of.cy_opencv)]
    words = [f"{name} = {a:.1f} ({b:.1f} given)" for name, (a, b) in zip(("fx", "fy", "cx", "cy"), pairs, strict=True)]
    words.append(f"k1 = {found.lens[0]:.4f} ({given.lens[0]:.4f} given)")
    return ", ".join(word for n, word in enumerate(words) if chosen is None or chosen[n])
