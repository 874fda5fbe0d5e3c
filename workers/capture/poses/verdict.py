"""Which views fit an estimate, by which evidence.

- What the three estimates of a capture are made from.
- What becomes of a view's pose: used, flagged or refused, with reasons that name the number measured.
"""

import math
from dataclasses import dataclass

import numpy as np

from schemas.base import Array, Pose
from schemas.capture import CaptureCamera, DepthCorrection, ViewEstimate, ViewStatus
from schemas.job.captures import Board, Estimation
from workers.capture.poses.markers import MarkerPose, measured_corner_px
from workers.capture.poses.observation import Observation, Patches, Setup, pixels_of_points
from workers.geometry.frames import transform


@dataclass(frozen=True, eq=False)
class Evidence:
    """The views of a capture in order of number, each with its pose from markers; corner_px: measured sigma of a corner."""

    setup: Setup
    observations: tuple[Observation, ...]
    markers: tuple[MarkerPose, ...]
    corner_px: float

    @staticmethod
    def of(setup: Setup, observations: list[Observation], markers: list[MarkerPose]) -> "Evidence":
        """With the sigma of a corner measured over all views."""
        return Evidence(setup, tuple(observations), tuple(markers), measured_corner_px(markers, setup.spec))

    @property
    def camera(self) -> CaptureCamera:
        """The colour camera."""
        return self.setup.camera

    @property
    def board(self) -> Board:
        """The board as board.json has it."""
        return self.setup.board

    @property
    def spec(self) -> Estimation:
        """How poses are estimated."""
        return self.setup.spec


MAX_SIGMA_M = 0.005
MAX_SIGMA_RAD = math.radians(1.0)
"""A pose that is less certain than this spoils a cloud; its view is flagged."""
MIN_CORNERS = 4


@dataclass(frozen=True, eq=False)
class Judged:
    """A view's pose in one estimate, before it is judged: T_board_cam or None, covariance [6, 6] or None, known faults."""

    T_board_cam: Pose | None
    covariance: Array | None = None
    faults: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    """Said of a view that is used."""
    by_corners: bool = True
    """Whether the covariance is by the sigma of a corner, and must grow where the view's corners fit worse than that."""


def judge(
    observation: Observation, pose: Judged, evidence: Evidence, depth: DepthCorrection, print_scale: float = 1.0
) -> ViewEstimate:
    """The estimate of one view, with its residuals."""
    number, markers, T = observation.number, observation.markers, pose.T_board_cam
    if T is None or not np.isfinite(T).all():
        reasons = pose.faults or ("no pose was found",)
        return ViewEstimate(number, "refused", None, None, markers, None, None, reasons)
    reprojection_px = median_reprojection(observation, T, evidence.camera, print_scale)
    most_px = evidence.spec.max_reprojection_px
    covariance = pose.covariance
    if pose.by_corners:
        covariance = _widened(covariance, reprojection_px, len(observation.corners.board), evidence.corner_px)
    faults = [*pose.faults, *_doubts(covariance)]
    if reprojection_px is not None and reprojection_px > most_px:
        faults.append(
            f"median reprojection error {reprojection_px:.2f} px, above max_reprojection_px {most_px:g}: "
            "the markers do not lie as board.json says, or the view is blurred"
        )
    status: ViewStatus = "flagged" if faults else "used"
    depth_mm = median_board_distance(observation.board_patches, T, depth)
    return ViewEstimate(number, status, T, covariance, markers, reprojection_px, depth_mm, (*faults, *pose.remarks))


def median_reprojection(observation: Observation, T: Pose, camera: CaptureCamera, print_scale: float) -> float | None:
    """Median distance, pixels, of all corners found from where the pose projects them; None without corners."""
    corners = observation.corners
    if not len(corners.board):
        return None
    distance = np.linalg.norm(pixels_of_points(corners.board * print_scale, T, camera) - corners.pixels, axis=1)
    return float(np.median(np.where(np.isfinite(distance), distance, 1e6)))


def median_board_distance(patches: Patches, T: Pose, depth: DepthCorrection) -> float | None:
    """Median distance, millimetres, of the board as depth measures it from the board's plane; None without depth there."""
    if not len(patches):
        return None
    points = transform(T, corrected_points(patches, depth))
    return 1000 * float(np.median(np.abs(points[:, 2])))


def corrected_points(patches: Patches, depth: DepthCorrection) -> Array:
    """[P, 3] metres, camera axes: the patches' middles after the correction of depth."""
    return transform(depth.T_cam_depth, depth.scale * patches.ray_z + depth.offset_m * patches.ray)


def _widened(covariance: Array | None, reprojection_px: float | None, corners: int, corner_px: float) -> Array | None:
    """The covariance of a view whose corners fit worse than those of the capture do, by how much worse.

    The median of a Rayleigh law is 1.177 sigma; of 2 K coordinates 6 are used up by the pose.
    """
    if covariance is None or reprojection_px is None or corners < MIN_CORNERS:
        return covariance
    worse = (reprojection_px / (1.1774 * corner_px)) ** 2 * (2 * corners) / (2 * corners - 6)
    return covariance * max(1.0, worse)


def _doubts(covariance: Array | None) -> list[str]:
    if covariance is None:
        return []
    sigma_m = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:3, :3])[-1])))
    sigma_rad = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])))
    if sigma_m <= MAX_SIGMA_M and sigma_rad <= MAX_SIGMA_RAD:
        return []
    return [f"the pose is uncertain: {1000 * sigma_m:.1f} mm, {math.degrees(sigma_rad):.2f} degrees (one sigma)"]
