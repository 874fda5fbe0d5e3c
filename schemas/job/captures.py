"""The `captures` branch of a job: real or simulated photographs of one object on a marker board, and how they are processed.

A job with this branch makes captures in place of scenes: capture number n is the scene with id first_scene + n.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from schemas.base import (
    Folder,
    Frozen,
    Interval,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveInt,
    Range,
    Share,
    Text,
)
from schemas.job.assets import CategoryName
from schemas.job.keys import with_defaults
from schemas.job.views import Distortion, Exposure, RgbNoise

Estimate = Literal["markers", "article", "joint"]
BoardFrame = Literal["centre", "opencv", "opencv_old"]
"""Where a board pose has its origin: `centre` as board.json has it, y up the print, z out; OpenCV's since 4.6 at the top left,
y down, z into the board; OpenCV's before, and Kalibr's, at the bottom left, y up, z out."""
ESTIMATES: tuple[Estimate, ...] = ("markers", "article", "joint")


Point = tuple[float, float, float]
Quad = tuple[Point, Point, Point, Point]


class Marker(Frozen):
    """One marker of a board that is no grid."""

    id: NonNegativeInt
    """In the dictionary."""
    corners: Quad
    """Clockwise from the upper left of OpenCV's picture; metres."""


GRID_KEYS = ("columns", "rows", "marker_m", "gap_m", "first_id")


class Board(Frozen):
    """The markers beside the object (board.json): a grid of unique ArUco markers on a flat board, or `markers` anywhere.

    Board frame: z = 0 is the surface that the object stands on, z up, metres. Of a grid, origin at its centre, x along the rows
    to the right, y up the print; marker `first_id` is at the top left, and ids run along the rows.
    """

    dictionary: Text = "DICT_4X4_50"
    """A predefined dictionary of OpenCV, or the name of a file beside board.json in OpenCV's dictionary format."""
    columns: Annotated[int, Field(ge=1, le=100)] = 7
    """Markers in a row."""
    rows: Annotated[int, Field(ge=1, le=100)] = 5
    """Rows of markers."""
    marker_m: Annotated[float, Field(gt=0, le=10)] = 0.06
    """Side of a marker, its black border included, metres."""
    gap_m: Annotated[float, Field(gt=0, le=10)] = 0.02
    """Between two markers, metres."""
    width_m: Annotated[float, Field(gt=0, le=100)] = 0.60
    """Width of the whole board about the origin."""
    height_m: Annotated[float, Field(gt=0, le=100)] = 0.40
    """Height of the whole board."""
    first_id: NonNegativeInt = 0
    """Id of the marker at the top left; ids run along the rows."""
    ruler_m: Positive = 0.20
    """Nominal length of the printed ruler."""
    measured_ruler_m: Positive | None = None
    """Length of the ruler measured on the print; it scales every length of the board."""
    border_bits: Annotated[int, Field(ge=1, le=4)] = 1
    """Width of the markers' black border, in bits."""
    markers: Annotated[tuple[Marker, ...], Field(max_length=10_000)] = ()
    """Any ids in any places; in place of the grid."""
    squares: Annotated[tuple[Quad, ...], Field(max_length=20_000)] = ()
    """Plain black squares beside `markers`, such as a chessboard's."""

    @property
    def scale(self) -> float:
        """True size over nominal size of the print; 1 where nobody measured it."""
        return 1.0 if self.measured_ruler_m is None else self.measured_ruler_m / self.ruler_m

    @property
    def words(self) -> str:
        """How many markers there are: `7 x 5 markers`, or `12 markers`."""
        return f"{len(self.markers) or f'{self.columns} x {self.rows}'} markers"

    @property
    def unwritten(self) -> set[str]:
        """Keys that board.json leaves out: those of the other kind of board, and a border of the usual width."""
        return {*(GRID_KEYS if self.markers else ("markers", "squares")), *(("border_bits",) * (self.border_bits == 1))}

    @model_validator(mode="before")
    @classmethod
    def _is_one_kind(cls, keys: Any) -> Any:
        if isinstance(keys, Mapping):
            usual = {name: cls.model_fields[name].default for name in GRID_KEYS}
            grid = [name for name in GRID_KEYS if keys.get(name, usual[name]) != usual[name]]
            if keys.get("markers") and grid:
                raise ValueError(f"{grid[0]} is of a grid, and markers are given one by one: leave one of both out")
            if keys.get("squares") and not keys.get("markers"):
                raise ValueError("squares stand beside markers that are given one by one, and there are no markers")
        return keys

    @model_validator(mode="after")
    def _fits(self) -> "Board":
        for name, count, size in (("width_m", self.columns, self.width_m), ("height_m", self.rows, self.height_m)):
            needed = count * self.marker_m + (count - 1) * self.gap_m
            if needed > size + 1e-9 and not self.markers:
                raise ValueError(f"{name} is {size:g}, and {count} markers with their gaps need {needed:g}")
        if not 0.5 <= self.scale <= 2.0:
            raise ValueError(f"measured_ruler_m over ruler_m is {self.scale:g}: must be between 0.5 and 2")
        return self

    @model_validator(mode="after")
    def _has_square_markers(self) -> "Board":
        once: set[int] = set()
        for marker in self.markers:
            if marker.id in once:
                raise ValueError(f"marker {marker.id} is there twice")
            once.add(marker.id)
        quads = {f"marker {marker.id}": marker.corners for marker in self.markers}
        quads |= {f"square {n}": corners for n, corners in enumerate(self.squares)}
        for name, corners in quads.items():
            if not _is_square(corners):
                raise ValueError(f"{name}: its corners {[list(p) for p in corners]} are no square, one after the other")
            for key, axis, size in (("width_m", 0, self.width_m), ("height_m", 1, self.height_m)):
                if (reach := 2 * max(abs(p[axis]) for p in corners)) > size + 1e-9:
                    raise ValueError(f"{key} is {size:g}, and {name} needs {reach:g} about the origin")
        if self.markers and all(_height_of_normal(marker.corners) < -0.5 for marker in self.markers):
            raise ValueError("all markers face down: their corners run clockwise as seen from above, z up")
        return self


SQUARE = 0.02
"""Share by which sides and diagonals of a marker may differ from a square's: it was measured by hand."""


def _is_square(corners: Quad) -> bool:
    sides = [math.dist(corners[k], corners[(k + 1) % 4]) for k in range(4)]
    diagonals = [math.dist(corners[k], corners[k + 2]) / math.sqrt(2.0) for k in range(2)]
    low, high = min(*sides, *diagonals), max(*sides, *diagonals)
    return low > 0.0 and high <= 10.0 and high <= low * (1.0 + SQUARE)


def _height_of_normal(corners: Quad) -> float:
    """z of the unit normal of a square, towards who sees its corners run clockwise."""
    (ax, ay, _), (bx, by, _), _, (dx, dy, _) = corners
    area = math.dist(corners[0], corners[1]) * math.dist(corners[0], corners[3])
    return ((by - ay) * (dx - ax) - (bx - ax) * (dy - ay)) / area


class KinectDepthNoise(Frozen):
    """Noise of the simulated depth camera; its numbers and their sources are in workers/capture/simulate."""

    times: NonNegative = 1.0
    """Factor on every random error of the preset."""
    bias_m: float = 0.0
    """Further systematic error, metres."""


class MotionBlur(Frozen):
    """Movement of the hand-held camera during an exposure."""

    exposure_s: Positive = 0.008
    """Time that the shutter is open."""
    speed_m_s: NonNegative = 0.15
    """Speed of the camera."""
    turn_deg_s: NonNegative = 8.0
    """And its turning."""


class RollingShutter(Frozen):
    """Rows that are read one after the other while the camera moves; a view's pose is that of its middle row."""

    readout_s: Positive = 0.02
    """First row to last."""
    speed_m_s: NonNegative = 0.15
    """As of `motion_blur`."""
    turn_deg_s: NonNegative = 8.0
    """As of `motion_blur`."""


class Sharpen(Frozen):
    """Sharpening in the camera: an unsharp mask on encoded values."""

    amount: NonNegative = 1.0
    """Share of the difference from the blurred image that is added."""
    radius_px: Positive = 1.0
    """Standard deviation of that blur."""


class ToneCurve(Frozen):
    """What the camera stores in place of sRGB."""

    linear: bool = False
    """Codes are linear light."""
    contrast: Share = 0.3
    """Steepening of the middle of an S-curve through black, middle grey and white."""


class Jpeg(Frozen):
    """Loss of a JPEG file; what it decodes to is stored."""

    quality: Annotated[int, Field(ge=1, le=100)] = 85
    """As in libjpeg."""


class HiddenMarkers(Frozen):
    """Patches of paper that cover markers in part."""

    share: Share = 0.15
    """Share of the markers that are covered in part."""


class RegistrationError(Frozen):
    """Error of the depth camera's assumed place: what registers depth to colour uses this wrong pose."""

    shift_m: Annotated[list[float], Field(min_length=3, max_length=3)] = Field(
        default_factory=lambda: [0.010, 0.0, 0.0]
    )
    """Error of the assumed place along the axes of the colour camera."""
    turn_deg: float = 0.0
    """Error of the assumed orientation, about the vertical axis of the colour camera."""


class Simulate(Frozen):
    """A virtual capture with known truth; an effect that is not asked for is not simulated."""

    views: Annotated[int, Field(ge=1, le=1000)] = 40
    """Viewpoints of a capture."""
    distance_m: Interval = Range(0.6, 1.0)
    """Of the camera to the middle of the object."""
    inclination_rad: Interval = Range(0.5, 1.2)
    """Angle of the optical axis below the horizontal."""
    roll_deg: NonNegative = 12.0
    """Standard deviation of the roll of the hand-held camera."""
    image_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Size of all images over the Azure Kinect's (1920 x 1080 and 640 x 576)."""
    tier: Literal["raster", "pathtraced"] = "raster"
    """How RGB is made."""
    depth_noise: KinectDepthNoise | None = None
    """Noise of the Azure Kinect's depth; nothing: exact depth."""
    rgb_noise: RgbNoise | None = None
    """Shot noise and read noise of RGB."""
    motion_blur: MotionBlur | None = None
    """Movement of the camera while it exposes."""
    rolling_shutter: RollingShutter | None = None
    """Rows read in turn."""
    exposure: Exposure | None = None
    """Exposure of every view."""
    tone_curve: ToneCurve | None = None
    """Tone curve of the camera; nothing: sRGB."""
    sharpen: Sharpen | None = None
    """Sharpening in the camera."""
    jpeg: Jpeg | None = None
    """Photographs that were JPEG files."""
    distortion: Distortion | None = None
    """Lens of the colour camera; nothing: a pinhole."""
    hidden_markers: HiddenMarkers | None = None
    """Patches of paper on the board."""
    print_scale: Annotated[float, Field(gt=0.5, lt=2)] | None = None
    """True size of the print over its nominal size."""
    registration_error: RegistrationError | None = None
    """Error of the depth camera's assumed pose."""


class Estimation(Frozen):
    """How the camera poses are estimated."""

    estimate: Estimate = "joint"
    """Which estimate the cloud and the dataset are made with; all three are reported."""
    compare: bool = True
    """Compute the other two as well."""
    max_iterations: PositiveInt = 100
    """Most iterations of `article` and of `joint`."""
    min_markers: PositiveInt = 1
    """A view with fewer markers is not used."""
    max_reprojection_px: Positive = 3.0
    """A view whose median reprojection error is larger is flagged and not used."""
    corner_px: Positive = 0.2
    """Standard deviation of a detected corner, which weighs corners against depth."""
    depth_sigma_m: Positive = 0.003
    """Standard deviation of depth at 1 m, which grows with the square of the distance; measured anew from the capture."""
    calibrate: bool = False
    """Take the camera from the markers of all views where camera.json does not fit them."""
    trust: Literal["print", "depth"] = "print"
    """What is metric truth where the print and the depth disagree about the scale."""


class Fusion(Frozen):
    """How the views' depth is merged into one cloud and one mesh."""

    voxel_m: Annotated[float, Field(ge=0.0005, le=0.02)] = 0.002
    """Distance of the points of the cloud."""
    max_edge_deg: Annotated[float, Field(gt=0, le=90)] = 84.0
    """Pixels beyond this angle of incidence are left out."""
    board_clearance_m: NonNegative = 0.003
    """What is nearer to the board's plane than this is the board's, but for floors; more where depth is uneven."""
    min_views: PositiveInt = 2
    """Views that must confirm a point, or one that none contradicts."""


class Synthesis(Frozen):
    """How views from other poses are made."""

    views: PositiveInt = 6
    """Captured views that are merged: those with the nearest optical axes."""
    fill_px: NonNegativeInt = 3
    """Holes up to about this size are filled, and counted as not measured."""


class Captures(Frozen):
    """Captures in place of scenes."""

    source: Literal["simulate", "folders"] = "simulate"
    """Virtual captures with known truth, or folders of photographs."""
    folders: Annotated[list[Folder], Field(max_length=10_000)] = Field(default_factory=list)
    """For source `folders`: one folder a capture, in order; relative to the job file."""
    category: CategoryName = "object"
    """For source `folders`: the category of captures whose capture.json names none."""
    board: Board = Board()
    """The marker board of simulated captures; a folder has its own board.json."""
    simulate: Simulate = Simulate()
    """Virtual captures."""
    estimation: Estimation = Estimation()
    """How the camera poses are estimated."""
    fusion: Fusion = Fusion()
    """How the views are merged."""
    synthesis: Synthesis = Synthesis()
    """How mirror views are made."""
    most_views: Annotated[int, Field(ge=1, le=1000)] = 64
    """Views of a capture that are stored: fixes the arithmetic of pose ids."""

    @model_validator(mode="after")
    def _has_folders(self) -> "Captures":
        if (self.source == "folders") != bool(self.folders):
            raise ValueError("folders must be named for source: folders, and for it alone")
        if self.source == "simulate" and self.simulate.views > self.most_views:
            told = f"simulate.views is {self.simulate.views}, and most_views is {self.most_views}: raise most_views"
            raise ValueError(told)
        return self


def with_capture_keys(tree: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a job's keys, with those that follow from `captures` where the job does not give them.

    `scenes` is the number of folders, `pairs_per_scene` is `most_views`, and there are no aligned views: depth of a capture
    is registered to its colour camera. A capture takes as long as dozens of scenes, so each is committed by itself.
    """
    captures = tree.get("captures")
    if not isinstance(captures, Mapping):
        return with_defaults(tree, {})
    usual = {"pairs_per_scene": captures.get("most_views", Captures.model_fields["most_views"].default)}
    usual |= {"cameras.depth.enabled": False, "run.range_size": 1, "run.scene_timeout_s": 1800.0}
    if isinstance(folders := captures.get("folders"), list) and folders:
        usual["scenes"] = len(folders)
    return with_defaults(tree, usual)
