"""The `captures` branch of a job: real or simulated photographs of one object on a marker board, and how they are processed.

A job with this branch makes captures in place of scenes: capture number n is the scene with id first_scene + n.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

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
    with_defaults,
)
from schemas.job.views import Distortion, Exposure, RgbNoise

Estimate = Literal["markers", "article", "joint"]
BoardFrame = Literal["centre", "opencv", "opencv_old"]
"""Where a board pose has its origin: `centre` as board.json has it, y up the print, z out; OpenCV's since 4.6 at the top left,
y down, z into the board; OpenCV's before, and Kalibr's, at the bottom left, y up, z out."""
UNNAMED = "object"
"""The category of a capture whose capture.json names none."""

ESTIMATES: tuple[Estimate, ...] = get_args(Estimate)


Point = tuple[float, float, float]
Quad = tuple[Point, Point, Point, Point]


class Marker(Frozen):
    """One marker of a board that is no grid."""

    id: NonNegativeInt
    """In the dictionary."""
    corners: Quad
    """Clockwise from the upper left of OpenCV's picture; metres."""


GRID_KEYS = ("columns", "rows", "marker_m", "gap_m", "first_id")


class Grid(Frozen):
    """A grid of unique ArUco markers on a flat board: what virtual captures have beside their object."""

    dictionary: Text = "DICT_4X4_50"
    """A predefined dictionary of OpenCV, or the name of a file beside board.json in OpenCV's dictionary format."""
    columns: Annotated[int, Field(ge=1, le=100)] = 7
    """Markers in a row."""
    rows: Annotated[int, Field(ge=1, le=100)] = 5
    """Rows of markers."""
    marker_m: Annotated[float, Field(gt=0, le=10)] = 0.06
    """Side of a marker with its black border."""
    gap_m: Annotated[float, Field(gt=0, le=10)] = 0.02
    """Between two markers."""
    width_m: Annotated[float, Field(gt=0, le=100)] = 0.60
    """Width of the whole board about the origin."""
    height_m: Annotated[float, Field(gt=0, le=100)] = 0.40
    """Height of the whole board."""

    @model_validator(mode="after")
    def _fits(self) -> "Grid":
        for name, count, size in (("width_m", self.columns, self.width_m), ("height_m", self.rows, self.height_m)):
            needed = count * self.marker_m + (count - 1) * self.gap_m
            if needed > size + 1e-9 and not getattr(self, "markers", ()):
                raise ValueError(f"{name} is {size:g}, and {count} markers with their gaps need {needed:g}")
        return self


class Board(Grid):
    """The markers beside an object (board.json): a grid, or `markers` anywhere.

    Board frame: z = 0 is the surface that the object stands on, z up, metres. Of a grid, origin at its centre, x along the rows
    to the right, y up the print; marker `first_id` is at the top left, and ids run along the rows.
    """

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
    def _has_true_size(self) -> "Board":
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
    """Further systematic error."""


class ToneCurve(Frozen):
    """What the camera stores in place of sRGB."""

    linear: bool = False
    """Codes are linear light."""
    contrast: Share = 0.3
    """Steepening of the middle of an S-curve through black, middle grey and white."""


class RegistrationError(Frozen):
    """Error of the depth camera's assumed place: what registers depth to colour uses this wrong pose."""

    shift_m: Annotated[list[float], Field(min_length=3, max_length=3)] = Field(
        default_factory=lambda: [0.010, 0.0, 0.0]
    )
    """Of the assumed place, along the axes of the colour camera."""
    turn_deg: float = 0.0
    """Of the assumed orientation, about the vertical axis of the colour camera."""


class Simulate(Frozen):
    """A virtual capture with known truth; an effect that is not asked for is not simulated."""

    views: Annotated[int, Field(ge=1, le=1000)] = 40
    """Viewpoints of a capture."""
    distance_m: Interval = Range(0.6, 1.0)
    """Of the camera to the middle of the object."""
    inclination_rad: Interval = Range(0.5, 1.2)
    """Angle of the optical axis below the horizontal."""
    image_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Size of all images over the Azure Kinect's (1920 x 1080 and 640 x 576)."""
    tier: Literal["raster", "pathtraced"] = "raster"
    """How RGB is made."""
    depth_noise: KinectDepthNoise | None = None
    """Noise of the Azure Kinect's depth."""
    rgb_noise: RgbNoise | None = None
    """Shot noise and read noise of RGB."""
    motion_blur: Positive | None = None
    """Seconds that the shutter is open, such as 0.008, while the camera moves at 0.15 m/s and turns at 8 degrees a second."""
    rolling_shutter: Positive | None = None
    """Seconds from the first row to the last, such as 0.02, while the camera moves as much; a pose is that of the middle row."""
    exposure: Exposure | None = None
    """Exposure of every view."""
    tone_curve: ToneCurve | None = None
    """Tone curve of the camera in place of sRGB."""
    sharpen: NonNegative | None = None
    """Share, such as 1, of the difference from the image blurred by a pixel that the camera adds to encoded values."""
    jpeg: Annotated[int, Field(ge=1, le=100)] | None = None
    """Quality, as in libjpeg, such as 85, of JPEG files; what they decode to is stored."""
    distortion: Distortion | None = None
    """Lens of the colour camera."""
    hidden_markers: Share | None = None
    """Share, such as 0.15, of the markers that paper covers in part."""
    print_scale: Annotated[float, Field(gt=0.5, lt=2)] | None = None
    """True size of the print over its nominal size."""
    registration_error: RegistrationError | None = None
    """Error of the depth camera's assumed pose."""


class Estimation(Frozen):
    """How the camera poses are estimated."""

    estimate: Estimate = "joint"
    """Estimate that the cloud and the dataset are made with."""
    compare: bool = True
    """Whether the other two are made and reported as well."""
    max_iterations: PositiveInt = 100
    """Most iterations of `article` and of `joint`."""
    corner_px: Positive = 0.2
    """Standard deviation of a detected corner, which weighs corners against depth."""
    calibrate: bool = False
    """Take the camera from the markers of all views where camera.json does not fit them."""
    trust: Literal["print", "depth"] = "print"
    """What is metric truth where print and depth disagree about the scale."""


class Fusion(Frozen):
    """How the views' depth is merged into one cloud and one mesh."""

    voxel_m: Annotated[float, Field(ge=0.0005, le=0.02)] = 0.002
    """Distance of the points of the cloud."""
    board_clearance_m: NonNegative = 0.003
    """What is nearer to the board's plane than this is the board's, but for floors; more where depth is uneven."""
    min_views: PositiveInt = 2
    """Views that must confirm a point, or one that none contradicts."""


class Synthesis(Frozen):
    """How views from other poses are made."""

    views: PositiveInt = 6
    """Captured views that are merged: those of the nearest optical axes."""


class Captures(Frozen):
    """Captures in place of scenes."""

    folders: Annotated[list[Folder], Field(max_length=10_000)] = Field(default_factory=list)
    """Folders of captures, in order, relative to the job file. None: virtual captures with known truth."""
    board: Grid = Grid()
    """The marker board of virtual captures; a folder has its own board.json."""
    simulate: Simulate = Simulate()
    """Virtual captures."""
    estimation: Estimation = Estimation()
    """How the camera poses are estimated."""
    fusion: Fusion = Fusion()
    """How the views are merged."""
    synthesis: Synthesis = Synthesis()
    """How mirror views are made."""

    @property
    def printed_board(self) -> Board:
        """The marker board of virtual captures, as board.json has it."""
        return Board(**self.board.model_dump())


def with_capture_keys(tree: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a job's keys, with those that follow from `captures` where the job does not give them.

    `scenes` is the number of folders, of each capture 64 views are stored at most, and there are no aligned views: depth of a
    capture is registered to its colour camera. A capture takes as long as dozens of scenes, so each is committed by itself.
    """
    captures = tree.get("captures")
    if not isinstance(captures, Mapping):
        return with_defaults(tree, {})
    usual = {"pairs_per_scene": 64, "cameras.depth.enabled": False, "run.range_size": 1, "run.scene_timeout_s": 1800.0}
    if isinstance(folders := captures.get("folders"), list) and folders:
        usual["scenes"] = len(folders)
    return with_defaults(tree, usual)
