"""Estimated camera poses of a capture, with their uncertainty and residuals."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.capture.view import Detection
from schemas.job.captures import Estimate

ViewStatus = Literal["used", "flagged", "refused"]
"""`used`: part of the result; `flagged`: has a pose, and is left out of the cloud; `refused`: no pose could be estimated."""


@dataclass(frozen=True, eq=False)
class DepthCorrection:
    """How measured depth becomes points of the colour camera: p = T_cam_depth (ray (scale z + offset_m)).

    ray is ((u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, 1); T_cam_depth [4, 4] corrects the registration; all near identity.
    `identified` names the parameters that the capture determines; the others stay at their prior.
    """

    offset_m: float = 0.0
    scale: float = 1.0
    T_cam_depth: Pose = field(default_factory=lambda: frozen_array(np.eye(4)))
    identified: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ViewEstimate:
    """One view's pose in one estimate.

    T_board_cam [4, 4] takes camera coordinates to board coordinates, None where refused; covariance [6, 6] of a small motion
    (metres, then radians, camera axes) or None; reprojection_px: median over corners, of all that were found;
    depth_mm: median distance of board points measured by depth from the board's plane, after the correction, or None.
    `reasons` says why a view is flagged or refused, with the number measured.
    """

    number: int
    status: ViewStatus
    T_board_cam: Pose | None
    covariance: Array | None
    markers: int
    reprojection_px: float | None
    depth_mm: float | None
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class CaptureEstimate:
    """One of the three estimates of a capture: every view in order of number, and what all views share.

    `print_scale`: true size of the print over the size in board.json, 1 unless estimated. `notes`: what the user must know,
    for example that print and depth disagree about the scale. `seconds` of processor time, by stage.
    """

    estimate: Estimate
    views: tuple[ViewEstimate, ...]
    depth: DepthCorrection = DepthCorrection()
    print_scale: float = 1.0
    iterations: int = 0
    converged: bool = True
    notes: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def used(self) -> tuple[ViewEstimate, ...]:
        """The views that take part in the result."""
        return tuple(view for view in self.views if view.status == "used")


@dataclass(frozen=True, eq=False)
class Estimates:
    """The estimates of one capture side by side, and the markers that they were made from.

    `chosen` names the one that the cloud and the dataset are made with; it is always among `by_name`. `seconds` of processor
    time of what all estimates share (read, detect, sample depth).
    """

    chosen: Estimate
    by_name: Mapping[Estimate, CaptureEstimate]
    detections: tuple[Detection, ...]
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def estimate(self) -> CaptureEstimate:
        """The one that was chosen."""
        return self.by_name[self.chosen]

    @property
    def by_markers(self) -> dict[int, ViewEstimate]:
        """The views of the estimate from markers alone, by number; none where it was not made."""
        markers = self.by_name.get("markers")
        return {view.number: view for view in markers.views} if markers is not None else {}


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The merged surface of a capture's object, board frame, metres.

    points [N, 3] float64 with normals [N, 3] (unit, outwards), colors [N, 3] uint8 sRGB and views [N] int32 (how many views
    confirm the point); mesh vertices [V, 3] float64, faces [F, 3] int32, vertex_colors [V, 3] uint8.
    """

    points: Array
    normals: Array
    colors: np.ndarray
    views: np.ndarray
    vertices: Array
    faces: np.ndarray
    vertex_colors: np.ndarray
    seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SynthesizedView:
    """A view from a pose that was not captured.

    rgb [H, W, 3] uint8; depth_m [H, W] float64, 0 where there is nothing; mask [H, W] bool of the object; measured [H, W]
    bool: pixels that hold a measurement and were not filled; measured_share of the filled pixels; `sources`: numbers of the
    captured views that were merged.
    """

    rgb: np.ndarray
    depth_m: Array
    mask: np.ndarray
    measured: np.ndarray
    measured_share: float
    sources: tuple[int, ...]
