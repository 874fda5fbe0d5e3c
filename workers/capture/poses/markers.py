"""The estimate `markers`: each view's pose from the corners of its markers alone."""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.base import Array, Pose
from schemas.capture.view import CaptureCamera
from schemas.job.captures import Estimation
from workers.capture.poses.observation import Corners, Observation
from workers.capture.poses.reprojection import Fit, fit_pose
from workers.geometry.frames import angle_between, invert, pose

FLOOR_PX = 0.02
"""No corner is taken to be better than this."""
AMBIGUOUS = 9.0
"""The two poses of a planar target are told apart by at least this difference of their chi-square: three sigma."""
SAME_RAD = 0.02
"""Two poses that differ by less than this are one."""
PRIOR_RESIDUALS = 50
"""The expected sigma of a corner counts as much as so many measured residuals."""


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """One view's pose from its markers: the best fit, the rival that a planar target leaves, and what is wrong.

    fit is None where there is no pose, and `reason` then says why. `rival` is the other pose that fits, of another tilt.
    """

    number: int
    fit: Fit | None
    rival: Fit | None = None
    reason: str = ""


def fit_markers(observation: Observation, camera: CaptureCamera, spec: Estimation) -> MarkerPose:
    """The pose of one view: both solutions of the planar problem (IPPE), each refined with a robust loss, the better first."""
    corners, number = observation.corners, observation.number
    if observation.markers < spec.min_markers:
        found = observation.markers or "no"
        return MarkerPose(
            number, None, reason=f"{found} markers of the board found, and min_markers is {spec.min_markers}"
        )
    focal = focal_lengths(camera)
    fits = [fit_pose(start, corners.board, corners.rays, focal, FLOOR_PX) for start in planar_poses(corners)]
    fits = sorted((fit for fit in fits if _from_above(fit.T_board_cam)), key=lambda fit: fit.cost)
    if not fits:
        return MarkerPose(
            number,
            None,
            reason="the markers are seen from below the board: it is mirrored, or not the board of board.json",
        )
    rival = next((fit for fit in fits[1:] if _tilt_between(fits[0], fit) > SAME_RAD), None)
    return MarkerPose(number, fits[0], rival)


def planar_poses(corners: Corners) -> list[Pose]:
    """T_board_cam of the one or two poses from which a planar target looks alike (Collins and Bartoli 2014)."""
    found, rotations, translations, _ = cv2.solvePnPGeneric(
        corners.board.reshape(-1, 1, 3), corners.rays.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    poses = []
    for rotation, position in zip(rotations[:found], translations[:found], strict=True):
        T_cam_board = pose(cv2.Rodrigues(rotation)[0].astype(np.float64), position.ravel().astype(np.float64))
        if np.isfinite(T_cam_board).all():
            poses.append(invert(T_cam_board))
    return poses


def focal_lengths(camera: CaptureCamera) -> Array:
    """[2] float64, pixels."""
    return np.array([camera.intrinsics.fx, camera.intrinsics.fy])


def measured_corner_px(poses: list[MarkerPose], spec: Estimation) -> float:
    """Standard deviation of a detected corner in this capture, pixels, by the residuals of all views.

    The expected one, `corner_px`, counts as much as 50 residuals.
    """
    fits = [found.fit for found in poses if found.fit is not None and len(found.fit.residuals) > 3]
    residuals = np.concatenate([fit.residuals.ravel() for fit in fits]) if fits else np.zeros(0)
    free = len(residuals) - 6 * len(fits)
    if free <= 0:
        return spec.corner_px
    variance = (1.4826 * float(np.median(np.abs(residuals)))) ** 2 * len(residuals) / free
    mixed = (free * variance + PRIOR_RESIDUALS * spec.corner_px**2) / (free + PRIOR_RESIDUALS)
    return max(FLOOR_PX, float(np.sqrt(mixed)))


def is_ambiguous(found: MarkerPose, corner_px: float) -> bool:
    """Whether the corners do not tell the pose from its rival."""
    if found.fit is None or found.rival is None:
        return False
    return found.rival.cost - found.fit.cost < AMBIGUOUS * corner_px**2


def _from_above(T_board_cam: Pose) -> bool:
    return bool(np.isfinite(T_board_cam).all() and T_board_cam[2, 3] > 0)


def _tilt_between(a: Fit, b: Fit) -> float:
    return angle_between(a.T_board_cam[:3, :3], b.T_board_cam[:3, :3])
