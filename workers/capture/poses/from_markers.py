"""The estimate `markers` of a whole capture."""

import numpy as np

from schemas.capture.estimate import CaptureEstimate, DepthCorrection
from workers.capture.poses.evidence import Evidence
from workers.capture.poses.markers import MarkerPose, is_ambiguous
from workers.capture.poses.verdict import Judged, judge


def estimate_markers(evidence: Evidence) -> CaptureEstimate:
    """Each view by itself; the sigma of a corner, which tells how certain a pose is, is measured over all of them."""
    views = [
        judge(observation, judged(found, evidence.corner_px), evidence, DepthCorrection())
        for observation, found in zip(evidence.observations, evidence.markers, strict=True)
    ]
    return CaptureEstimate("markers", tuple(views), notes=(f"sigma of a corner: {evidence.corner_px:.3f} px",))


def judged(found: MarkerPose, corner_px: float) -> Judged:
    """The pose from markers with its covariance, and whether it is ambiguous."""
    if found.fit is None:
        return Judged(None, faults=(found.reason,))
    faults = []
    if is_ambiguous(found, corner_px):
        faults.append("ambiguous: a pose of another tilt fits the markers as well (planar target)")
    covariance = np.asarray(corner_px**2 * np.linalg.pinv(found.fit.information, hermitian=True), np.float64)
    return Judged(found.fit.T_board_cam, covariance, tuple(faults))
