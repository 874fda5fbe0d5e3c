"""What the steps of a capture hand to one another: cameras, views, detections, estimates, results."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.job.captures import Board, Estimate
from schemas.job.views import Distortion
from schemas.scene.view import Camera, Intrinsics


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """Intrinsics with pixel centres at +0.5, the lens of its images, and its pose beside the colour camera.

    `lens` holds OpenCV's rational model in OpenCV's order (k1, k2, p1, p2, k3, k4, k5, k6), [8] float64, all 0 for a
    pinhole. T_color_depth [4, 4] takes coordinates of the depth camera to the colour camera's, optical frames, metres.
    """

    intrinsics: Intrinsics
    lens: Array
    T_color_depth: Pose


@dataclass(frozen=True, eq=False)
class CaptureCamera:
    """The colour camera of a capture: a pinhole with pixel centres at +0.5, and the lens of its stored images.

    `lens` holds OpenCV's rational model in OpenCV's order (k1, k2, p1, p2, k3, k4, k5, k6), [8] float64, all 0 for a
    pinhole. Depth images have `depth_units_per_m` units a metre and are registered to this camera; `depth` is what their files
    measure: z along the optical axis, or the length of the ray.
    """

    intrinsics: Intrinsics
    lens: Array
    depth_units_per_m: float = 1000.0
    depth: Literal["z", "ray"] = "z"

    @property
    def has_lens(self) -> bool:
        """Whether the stored images are distorted."""
        return bool(np.any(self.lens))


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """One image of a recording, decoded when it is asked for.

    load(small): colour as rgb [H, W, 3] uint8, or small as grey [H / 2, W / 2] uint8; depth as [h, w] float64 metres, 0 for
    none, or small as anything at all. None for a frame that is damaged. `camera` where it is not the recording's: of colour
    the intrinsics, of depth the depth camera.
    """

    is_depth: bool
    stamp_us: int
    load: Callable[[bool], NDArray | None]
    camera: Intrinsics | DepthCamera | None = None


@dataclass(frozen=True, eq=False)
class Recorded:
    """An opened recording of any format: what every reader of one gives.

    `color` is None where nothing in it says what its colour camera is, and `missing` then says so. `units_per_m` keeps the
    steps of its depth; `with_units` opens it with others, where the format has no place for them. `frames` may be called
    again, and gives frames of colour and depth each in the order of time. `depth` is None where depth is registered to the
    colour camera. Time is microseconds; depth frames are `depth_delay_us` later than the colour frames they belong to;
    `duration_us` is the last time stamp by the file's own word, None where it has none because the recorder was interrupted.
    `told` goes into recording.json; `notes` are sentences for the user.
    """

    path: Path
    color: CaptureCamera | None
    depth: DepthCamera | None
    period_us: float
    frames: Callable[[], Iterator[RecordedFrame]]
    duration_us: float | None
    depth_delay_us: float = 0.0
    told: Mapping[str, str] = field(default_factory=dict)
    units_per_m: float = 1000.0
    missing: str = ""
    with_units: "Callable[[float], Recorded] | None" = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class CapturedView:
    """The images of one view as they are stored.

    rgb [H, W, 3] uint8 sRGB; depth [H, W] uint16, z along the optical axis in units of the camera, 0 where there is none,
    or None; mask [H, W] bool of the object, or None where none was given.
    """

    number: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None
    mask: NDArray[np.bool_] | None


@dataclass(frozen=True, eq=False)
class Detection:
    """The markers found in one view.

    ids [M] int64, ascending, unique; corners_px [M, 4, 2] float64, as stored (not undistorted), pixel centres at +0.5, in
    the order top left, top right, bottom right, bottom left of the printed marker. `dropped` says in words what was found and
    not used (a marker twice, an id that is not on the board). chess [K] int64: which corners of the board's chessboard were
    found, and chess_px [K, 2] where; none on other boards. `others`: those of further prints of the board in view.
    """

    number: int
    ids: NDArray[np.int64]
    corners_px: Array
    dropped: tuple[str, ...] = ()
    chess: NDArray[np.int64] = field(default_factory=lambda: frozen_array([], np.int64))
    chess_px: Array = field(default_factory=lambda: frozen_array(np.zeros((0, 2))))
    others: "tuple[Detection, ...]" = ()


@dataclass(frozen=True, eq=False)
class CaptureTruth:
    """What a simulated capture knows and no real one does.

    T_board_cam [V, 4, 4] by view number; T_board_obj [4, 4] pose of the object's mesh; `print_scale` true size of the print
    over its nominal size; T_color_depth [4, 4] true pose of the depth camera in the colour camera's frame; `depth_bias_m`
    further systematic error that was asked for.
    """

    T_board_cam: Array
    T_board_obj: Pose
    print_scale: float
    T_color_depth: Pose
    depth_bias_m: float
    lens: Distortion | None


@dataclass(frozen=True)
class CaptureListing:
    """folder: absolute; sha256: hex, of the names and the bytes of every input file."""

    folder: Path
    sha256: str


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
    `reasons` says why a view is flagged or refused, with the number measured, or what is left out of one that is used;
    is_cluttered: things on the board, such as a hand, that other views do not show are left out of it.
    """

    number: int
    status: ViewStatus
    T_board_cam: Pose | None
    covariance: Array | None
    markers: int
    reprojection_px: float | None
    depth_mm: float | None
    reasons: tuple[str, ...] = ()
    is_cluttered: bool = False


@dataclass(frozen=True, eq=False)
class CaptureEstimate:
    """One of the three estimates of a capture: every view in order of number, and what all views share.

    `print_scale`: true size of the print over the size in board.json, 1 unless estimated. `notes`: what the user must know,
    for example that print and depth disagree about the scale. `camera`: what the markers say where camera.json does not fit
    them. `seconds` of processor time, by stage.
    """

    estimate: Estimate
    views: tuple[ViewEstimate, ...]
    depth: DepthCorrection = DepthCorrection()
    print_scale: float = 1.0
    iterations: int = 0
    converged: bool = True
    notes: tuple[str, ...] = ()
    camera: CaptureCamera | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def used(self) -> tuple[ViewEstimate, ...]:
        """The views that take part in the result."""
        return tuple(view for view in self.views if view.status == "used")

    def view(self, number: int) -> ViewEstimate:
        """The view of this number."""
        return next(view for view in self.views if view.number == number)


@dataclass(frozen=True, eq=False)
class Estimates:
    """The estimates of one capture side by side.

    `chosen` names the one that the cloud and the dataset are made with; it is always among `by_name`. `seconds` of processor
    time of what all estimates share (read, detect, sample depth).
    """

    chosen: Estimate
    by_name: Mapping[Estimate, CaptureEstimate]
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


@dataclass(frozen=True, eq=False)
class SynthesizedView:
    """A view from a pose that was not captured.

    rgb [H, W, 3] uint8; depth_m [H, W] float64, 0 where there is nothing; mask [H, W] bool of the object, also where no view
    saw it; measured [H, W] bool: pixels that hold a measurement, which were not filled and, of the object, lie on its merged
    surface; measured_share of those with depth or of the object; `sources`: numbers of the captured views that were merged.
    """

    rgb: np.ndarray
    depth_m: Array
    mask: np.ndarray
    measured: np.ndarray
    measured_share: float
    sources: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class PosedImages:
    """A captured view without its lens: rgb [H, W, 3] uint8, depth_m [H, W] of the same camera, mask [H, W] of the object."""

    number: int
    camera: Camera
    rgb: NDArray[np.uint8]
    depth_m: Array
    mask: NDArray[np.bool_]


@dataclass(frozen=True)
class ViewScore:
    """Errors of one view against truth: of its pose, and the median of the depth that the other views together give for it.

    None where not measured.
    """

    pose_mm: float | None = None
    pose_deg: float | None = None
    depth_median_mm: float | None = None


@dataclass(frozen=True)
class CaptureScore:
    """Errors of a capture against truth: medians over the views, distances of the cloud, and by view number."""

    pose_mm: float | None = None
    pose_deg: float | None = None
    cloud_median_mm: float | None = None
    cloud_p95_mm: float | None = None
    completeness: float | None = None
    depth_median_mm: float | None = None
    views: Mapping[int, ViewScore] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ProcessedCapture:
    """A capture with its poses and its surface.

    `name` of the object; `images` reads a used view by its number; `synthesize` draws what another camera sees, poses in
    the board frame. `undistorted`: the stored images have a lens, which those of `images` have not. `depth_corrected`:
    the depth of `images` is corrected by what the estimate found.
    """

    name: str
    category: str
    licence: str
    board: Board
    estimates: Estimates
    surface: Reconstruction
    images: Callable[[int], PosedImages]
    synthesize: Callable[[Camera], SynthesizedView]
    undistorted: bool = False
    depth_corrected: bool = False
    score: CaptureScore | None = None
