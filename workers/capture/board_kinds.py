"""Boards of other kinds and of other programs' files, each made into the one model: markers at places, and black squares.

Sources: OpenCV's CharucoBoard, which is asked itself; Kalibr's kalibr_create_target_pdf and GridCalibrationTargetAprilgrid
(numbering from the lower left, squares at the corners of every tag, a border of two bits); apriltag_ros's tags.yaml
(x to the right of an upright tag, y up, z out of it); the marker maps of the ArUco library (aruco_bc_...); the settings of
OpenCV's camera calibration.
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.base import Array, frozen_array
from schemas.errors import InputError
from schemas.job.captures import Board
from workers.capture.board import LARGEST, PREDEFINED, board_geometry, predefined_dictionary, smallest_dictionary
from workers.geometry.frames import pose, rotation_from_quaternion, transform

SHEET_M = 0.03
"""White around all that is printed: ruler and text stand there."""
UPRIGHT = np.array([[0.0, 1, 0], [1, 1, 0], [1, 0, 0], [0, 0, 0]])
"""Corners of an upright square of side 1 from its lower left corner, clockwise from the upper left."""
TURNED = ("16h5", "25h9", "36h11")
"""Families of AprilTags that OpenCV draws upside down, by the codes of the AprilTag library; 36h10 is not checked."""


@dataclass(frozen=True)
class BoardSizes:
    """What a kind of board is made from: markers (aprilgrid) or squares (charuco) across and up.

    pitch_m: from a marker to the next, or the side of a square.
    """

    columns: int
    rows: int
    marker_m: float
    pitch_m: float
    dictionary: str


def make_grid(sizes: BoardSizes) -> Board:
    """A grid of ArUco markers."""
    extents = [(n - 1) * sizes.pitch_m + sizes.marker_m + 2 * SHEET_M for n in (sizes.columns, sizes.rows)]
    return _board(
        dictionary=sizes.dictionary,
        columns=sizes.columns,
        rows=sizes.rows,
        marker_m=sizes.marker_m,
        gap_m=sizes.pitch_m - sizes.marker_m,
        width_m=extents[0],
        height_m=extents[1],
        ruler_m=_ruler(extents[1]),
    )


def make_charuco(sizes: BoardSizes, legacy: bool = False) -> Board:
    """A ChArUco board as OpenCV 4.6 and later has it; `legacy`: as before, which differs where the rows are even."""
    dictionary = _predefined(sizes.dictionary)
    if not 0 < sizes.marker_m < sizes.pitch_m or min(sizes.columns, sizes.rows) < 2:
        raise InputError(
            f"a ChArUco board of {sizes.columns} x {sizes.rows} squares of {sizes.pitch_m:g} m has no room for markers of "
            f"{sizes.marker_m:g} m: make the squares larger than the markers, and at least 2 x 2"
        )
    theirs = cv2.aruco.CharucoBoard((sizes.columns, sizes.rows), sizes.pitch_m, sizes.marker_m, dictionary)
    theirs.setLegacyPattern(legacy)
    width, height = sizes.columns * sizes.pitch_m, sizes.rows * sizes.pitch_m
    markers = np.array(theirs.getObjPoints(), np.float64)  # from the upper left, y down
    with_marker = set(map(tuple, np.floor(markers.mean(axis=1)[:, :2] / sizes.pitch_m).astype(int).tolist()))
    cells = [(c, r) for r in range(sizes.rows) for c in range(sizes.columns) if (c, r) not in with_marker]
    unit = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    squares = sizes.pitch_m * (unit + [[[c, r, 0]] for c, r in cells])
    ours = [(quads - [0.5 * width, 0.5 * height, 0.0]) * [1.0, -1.0, 1.0] for quads in (markers, squares)]
    ids = np.asarray(theirs.getIds()).ravel().tolist()
    return board_of_markers(sizes.dictionary, ids, ours[0], ours[1], (width, height))


def make_aprilgrid(sizes: BoardSizes) -> Board:
    """Kalibr's grid of AprilTags: ids from the lower left, along the rows, then up; black squares at every tag's corners."""
    _predefined(sizes.dictionary)
    pitch, gap = sizes.pitch_m, sizes.pitch_m - sizes.marker_m
    width, height = ((n - 1) * pitch + sizes.marker_m for n in (sizes.columns, sizes.rows))

    def quads(columns: int, rows: int, from_m: float, side_m: float) -> Array:
        """[N, 4, 3]: squares of a side, a pitch apart from `from_m` on, along the rows, then up."""
        places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) * pitch + from_m
        return np.pad(places - [0.5 * width, 0.5 * height], ((0, 0), (0, 1)))[:, None] + side_m * UPRIGHT

    markers = _as_drawn(quads(sizes.columns, sizes.rows, 0.0, sizes.marker_m), sizes.dictionary)
    squares = quads(sizes.columns + 1, sizes.rows + 1, -gap, gap)
    ids = list(range(len(markers)))
    return board_of_markers(sizes.dictionary, ids, markers, squares, (width + 2 * gap, height + 2 * gap), border_bits=2)


KINDS: dict[str, Callable[[BoardSizes], Board]] = {
    "grid": make_grid,
    "charuco": make_charuco,
    "charuco_old": lambda sizes: make_charuco(sizes, legacy=True),
    "aprilgrid": make_aprilgrid,
}
"""Kinds of boards that can be printed."""


MOST_ACROSS = 25
"""Markers or squares across a board that is recognised."""
FITTING = 0.15
"""A corner this near to its place, in sides of its marker, lies there: markers of another layout are a whole side away."""
MOST_FIT = 0.8
"""Share of the markers that lie where a layout has them, if it is the board's: some may be misread."""
LEAST = 6
"""Fewer markers fit several layouts."""
NOMINAL = 0.7
"""Side of a marker, of its pitch, before it is known."""
SAME_PITCH = 0.03
"""A length of board.json so near to what the photographs show is that length."""


def recognise_board(
    views: Sequence[Mapping[int, Array]], board: Board, dictionary: str
) -> tuple[str, BoardSizes] | None:
    """(kind, sizes) of the board in views, each the rays [4, 2] of markers' corners by id; None if `board` or nothing fits.

    `dictionary` is the largest of the markers' family. Photographs tell the layout, and how wide a marker is beside its pitch:
    lengths are those of `board`.
    """
    best_view = max(views, key=len)
    ids, rays = np.array(sorted(best_view), np.int64), np.array([best_view[n] for n in sorted(best_view)])
    several = [n for n, count in Counter(n for view in views for n in view).items() if count >= min(2, len(views))]
    if min(len(ids), len(several)) < LEAST:
        return None
    count = max(several) + 1  # of one view alone an id may be misread
    best, most, share = None, max(_fit_layout(ids, rays, board)[0], MOST_FIT * len(ids) - 1, LEAST - 1), 1.0
    for kind, columns in product(KINDS, range(2, MOST_ACROSS + 1)):
        rows = -(-count // columns) if kind in ("grid", "aprilgrid") else max(2, -(-2 * count // columns))
        rows += kind == "charuco_old" and rows % 2  # with odd rows both patterns are one
        sizes = BoardSizes(columns, rows, NOMINAL, 1.0, dictionary)
        fits, side = _fit_layout(ids, rays, KINDS[kind](sizes))
        if fits > most:
            best, most, share = (kind, sizes), fits, NOMINAL * side
    if best is None:
        return None
    names = [smallest_dictionary(dictionary, int(board_geometry(KINDS[best[0]](best[1])).ids[-1]))]
    names += [board.dictionary] * (smallest_dictionary(board.dictionary, LARGEST) == dictionary)
    name = max(names, key=lambda name: (len(name), name))  # the larger
    marker_m = float(_sides(board_geometry(board).corners)[0])
    squares = _sides(board_geometry(board).squares)[:1]
    lengths = [marker_m / share, *squares, *(squares + marker_m)]
    lengths += [marker_m + board.scale * board.gap_m] * (not board.markers)
    pitch_m = next((m for m in lengths[1:] if abs(m / lengths[0] - 1) < SAME_PITCH), lengths[0])
    return best[0], replace(best[1], marker_m=round(marker_m, 5), pitch_m=round(float(pitch_m), 4), dictionary=name)


def _sides(quads: Array) -> Array:
    """[N]: upper sides of quads [N, 4, 3]."""
    return np.asarray(np.linalg.norm(quads[:, 1] - quads[:, 0], axis=1), np.float64)


def _fit_layout(ids: NDArray[np.int64], rays: Array, board: Board) -> tuple[int, float]:
    """(how many markers, by rays [M, 4, 2], lie as a flat board has them, their side over its), where pitch is the board's."""
    geometry = board_geometry(board)
    known = np.isin(ids, geometry.ids)
    quads = geometry.corners[geometry.index(ids[known]), :, :2] / _sides(geometry.corners)[0]
    middles = quads.mean(axis=1)
    if len(quads) < LEAST:
        return 0, 1.0
    H, _ = cv2.findHomography(rays[known].mean(axis=1), middles, cv2.RANSAC, FITTING)
    if H is None:
        return 0, 1.0
    lie = cv2.perspectiveTransform(rays[known].reshape(-1, 1, 2), H).reshape(-1, 4, 2) - middles[:, None]
    square = quads - middles[:, None]
    side = float(np.median((lie * square).sum(axis=(1, 2)) / (square**2).sum(axis=(1, 2))))
    off = np.abs(lie - side * square).max(axis=(1, 2))
    return int((off < FITTING * side).sum()), side


def _as_drawn(upright: Array, dictionary: str) -> Array:
    """Corners in the order of OpenCV's picture of tags whose corners [N, 4, 3] are in the order of the upright tag."""
    return np.roll(upright, -2, axis=1) if dictionary.endswith(TURNED) else upright


NO_SQUARES: Array = frozen_array(np.zeros((0, 4, 3)))


def board_of_markers(
    dictionary: str,
    ids: list[int],
    markers: Array,
    squares: Array = NO_SQUARES,
    size_m: tuple[float, float] | None = None,
    border_bits: int = 1,
) -> Board:
    """The board of markers [N, 4, 3] and squares [S, 4, 3]; `size_m` is the print's, by default what the markers cover."""
    points = np.concatenate([markers, squares, np.zeros((1, 4, 3))]).reshape(-1, 3)
    reach = 2.0 * np.abs(points[:, :2]).max(axis=0)
    width, height = (float(x) + 2 * SHEET_M for x in (size_m or reach))
    return _board(
        dictionary=dictionary,
        border_bits=border_bits,
        width_m=max(width, float(reach[0])),
        height_m=max(height, float(reach[1])),
        ruler_m=_ruler(height),
        markers=[{"id": n, "corners": quad} for n, quad in zip(ids, _rounded(markers), strict=True)],
        squares=_rounded(squares),
    )


def _rounded(points: Array) -> list[Any]:
    """To a tenth of a micrometre, so that a file is readable; OpenCV's places are in single precision."""
    return (np.round(points, 7) + 0.0).tolist()  # no -0


def _ruler(height_m: float) -> float:
    """The longest ruler of whole centimetres beside which the sheet has room, 20 at most."""
    return float(min(0.20, max(0.02, np.floor(100 * height_m - 4) / 100)))


def _board(**keys: Any) -> Board:
    try:
        return Board.model_validate(keys)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(f"the board cannot be: {f'{key}: ' if key else ''}{first['msg']}") from error


def _predefined(name: str) -> "cv2.aruco.Dictionary":
    if name not in PREDEFINED:
        raise InputError(f"{name!r} is no dictionary of OpenCV's (DICT_4X4_50, DICT_APRILTAG_36h11, ...)")
    return predefined_dictionary(name)


# ---------------------------------------------------------------------------------------------- files of other programs

MOST_BYTES = 4_000_000
"""Of a file that describes a board."""


def read_board_file(path: Path) -> Board:
    """The board of another program's file. Raises InputError with what is wrong, or which files are read."""
    try:
        data = path.read_bytes()[: MOST_BYTES + 1]
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    tree = _parse(path, data) if len(data) <= MOST_BYTES else None
    for key, (name, read) in FILES.items():
        if isinstance(tree, dict) and key in tree:
            try:
                return read(tree)
            except (KeyError, TypeError, ValueError, IndexError) as error:
                why = f"it has no {error.args[0]!r}" if isinstance(error, KeyError) else str(error)
                raise InputError(f"{path} is {name}, and cannot be used: {why}") from error
            except InputError as error:
                raise InputError(f"{path}: {error}") from error
    known = "; ".join(f"{name} (key {key})" for key, (name, _) in FILES.items())
    raise InputError(f"{path} describes no board that is known: {known}")


def _parse(path: Path, data: bytes) -> Any:
    """YAML, also as OpenCV writes it, or OpenCV's XML: None where it is neither."""
    text = data.decode("utf-8", "replace")
    if "<opencv_storage>" in text:
        values = re.findall(r"<(\w+)>\s*\"?([^<\"]*?)\"?\s*</\1>", text)
        return {name: yaml.safe_load(value) if value else None for name, value in values}
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]  # OpenCV writes %YAML:1.0
    spaced = re.sub(r"(?<=[{, ])(\w+):(?=[\w\[\"-])", r"\1: ", "\n".join(lines))  # and {id:0}
    try:
        aliases = any(isinstance(token, yaml.AliasToken) for token in yaml.scan(spaced))  # which can stand for any size
        return None if aliases else yaml.safe_load(spaced)
    except (yaml.YAMLError, RecursionError, ValueError):
        return None


def _read_kalibr(tree: dict[str, Any]) -> Board:
    if tree["target_type"] != "aprilgrid":
        raise ValueError(f"target_type is {tree['target_type']!r}, whose corners have no ids: aprilgrid is read")
    tag, spacing = float(tree["tagSize"]), float(tree["tagSpacing"])
    family = str(tree.get("tagFamily", "t36h11")).removeprefix("t")
    made = make_aprilgrid(
        BoardSizes(int(tree["tagCols"]), int(tree["tagRows"]), tag, tag * (1.0 + spacing), f"DICT_APRILTAG_{family}")
    )
    return made.model_copy(update={"border_bits": int(tree.get("blackTagBorder", made.border_bits))})


def _read_ros(tree: dict[str, Any]) -> Board:
    """The first bundle, or tags that stand alone, one of which has its place by being the only one."""
    family = str(tree.get("tag_family", "tag36h11")).removeprefix("tag").removeprefix("Standard")
    bundles, alone = tree.get("tag_bundles") or [], tree.get("standalone_tags") or []
    if len(bundles) > 1 or (bundles and alone) or (not bundles and len(alone) != 1):
        raise ValueError(
            f"it has {len(bundles)} bundles and {len(alone)} tags that stand alone, whose places beside one another are not "
            "known: leave one bundle, or one tag"
        )
    tags = bundles[0]["layout"] if bundles else alone
    dictionary, border_bits = f"DICT_APRILTAG_{family}", int(tree.get("tag_border", 1))
    _predefined(dictionary)
    corners = _as_drawn(np.array([_corners_of_tag(tag) for tag in tags], np.float64).reshape(-1, 4, 3), dictionary)
    return board_of_markers(dictionary, [int(tag["id"]) for tag in tags], corners, border_bits=border_bits)


def _corners_of_tag(tag: dict[str, Any]) -> Array:
    """[4, 3]: the corners of an upright tag, from the upper left clockwise, in the bundle's frame."""
    w, x, y, z = (float(tag.get(name, name == "qw")) for name in ("qw", "qx", "qy", "qz"))
    if not np.isclose(w * w + x * x + y * y + z * z, 1.0, atol=1e-3):
        raise ValueError(f"the quaternion of tag {tag['id']} has not length 1")
    R = rotation_from_quaternion(np.array([x, y, z, w]))
    T = pose(R, np.array([float(tag.get(name, 0.0)) for name in "xyz"]))
    return transform(T, float(tag["size"]) * (UPRIGHT - [0.5, 0.5, 0.0]))


def _read_map(tree: dict[str, Any]) -> Board:
    """A marker map of the ArUco library: metres if aruco_bc_mInfoType is 1."""
    if int(tree.get("aruco_bc_mInfoType", 1)) != 1:
        raise ValueError("aruco_bc_mInfoType is not 1: its lengths are pixels, write it in metres")
    markers = tree["aruco_bc_markers"]
    corners = np.array([marker["corners"] for marker in markers], np.float64)
    dictionary = str(tree.get("aruco_bc_dict", "ARUCO_MIP_36h12"))
    return board_of_markers(
        f"DICT_{dictionary.removeprefix('DICT_')}", [int(marker["id"]) for marker in markers], corners
    )


def _read_settings(tree: dict[str, Any]) -> Board:
    """The settings of OpenCV's calibration: sizes of squares and markers in millimetres, corners in place of squares."""
    if tree["Calibrate_Pattern"] != "CHARUCOBOARD":
        raise ValueError(
            f"Calibrate_Pattern is {tree['Calibrate_Pattern']!r}, whose corners have no ids: CHARUCOBOARD is read"
        )
    if float(tree["Square_Size"]) < 1.0:
        raise ValueError(f"Square_Size is {tree['Square_Size']}: write the sizes in millimetres")
    sizes = BoardSizes(
        int(tree["BoardSize_Width"]) + 1,
        int(tree["BoardSize_Height"]) + 1,
        float(tree["Marker_Size"]) / 1000.0,
        float(tree["Square_Size"]) / 1000.0,
        str(tree["ArUco_Dict_Name"]),
    )
    return make_charuco(sizes)


FILES: dict[str, tuple[str, Callable[[dict[str, Any]], Board]]] = {
    "target_type": ("a target of Kalibr", _read_kalibr),
    "tag_bundles": ("a bundle of tags of apriltag_ros", _read_ros),
    "standalone_tags": ("a tag of apriltag_ros", _read_ros),
    "aruco_bc_markers": ("a marker map of ArUco", _read_map),
    "Calibrate_Pattern": ("the settings of OpenCV's calibration", _read_settings),
}
"""Files of other programs that are read: by the key that tells one its name, and what makes a board of its keys."""
