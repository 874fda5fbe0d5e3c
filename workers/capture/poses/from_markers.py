"""The estimate `markers` of a whole capture."""

import numpy as np

from schemas.capture.estimate import CaptureEstimate, DepthCorrection
from schemas.capture.view import CaptureCamera
from schemas.job.captures import Estimation
from workers.capture.poses.markers import MarkerPose, is_ambiguous, measured_corner_px
from workers.capture.poses.observation import Observation
from workers.capture.poses.verdict import Judged, judge


def estimate_markers(
    observations: list[Observation], poses: list[MarkerPose], camera: CaptureCamera, spec: Estimation
) -> CaptureEstimate:
    """Each view by itself; the sigma of a corner, which tells how certain a pose is, is measured over all of them."""
    corner_px = measured_corner_px(poses, spec)
    views = [
        judge(observation, judged(found, corner_px), camera, spec, DepthCorrection())
        for observation, found in zip(observations, poses, strict=True)
    ]
    return CaptureEstimate("markers", tuple(views), notes=(f"sigma of a corner: {corner_px:.3f} px",))


def judged(found: MarkerPose, corner_px: float) -> Judged:
    """The pose from markers with its covariance, and whether it is ambiguous."""
    if found.fit is None:
        return Judged(None, faults=(found.reason,))
    faults = []
    if is_ambiguous(found, corner_px):
        faults.append("ambiguous: a pose of another tilt fits the markers as well (planar target)")
    covariance = np.asarray(corner_px**2 * np.linalg.pinv(found.fit.information, hermitian=True), np.float64)
    return Judged(found.fit.T_board_cam, covariance, tuple(faults))
