"""The marker board: its frame and those of others, the corners of its markers, and what is printed beside them."""

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from schemas.errors import CaptureError, InputError
from schemas.job.captures import Board, BoardFrame
from workers.geometry.frames import invert, pose, transform

TOUCHING_M = 1e-5
"""Corners so near to one another are one: places in a file are rounded."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where all that is printed lies, board frame, metres, true size; what any kind of board is made into.

    ids [N] int64 ascending; corners [N, 4, 3]: top left, top right, bottom right, bottom left of OpenCV's picture of each
    marker; squares [S, 4, 3]: plain black squares. chess [K, 3]: where two of them meet, corners of a chessboard;
    chess_squares, chess_corners [K, 2]: which two, and by which of their corners; chess_free_m [K]: half the side of the
    largest window about each that shows nothing else. right, below [N]: the marker whose left (upper) edge lies opposite to
    the right (lower) edge of one, at most a marker's side away, or -1.
    """

    ids: NDArray[np.int64]
    corners: Array
    squares: Array
    chess: Array
    chess_squares: NDArray[np.int64]
    chess_corners: NDArray[np.int64]
    chess_free_m: Array
    right: NDArray[np.int64]
    below: NDArray[np.int64]

    def index(self, ids: NDArray[np.int64]) -> NDArray[np.intp]:
        """Place of each id, which must be on the board."""
        return np.searchsorted(self.ids, ids)


@functools.lru_cache(maxsize=16)
def board_geometry(board: Board) -> Geometry:
    """What lies where; kept, because every view asks for it."""
    corners = marker_corners(board)
    squares = board.scale * np.array(board.squares, dtype=np.float64).reshape(-1, 4, 3)
    pairs = cKDTree(squares.reshape(-1, 3)).query_pairs(TOUCHING_M, output_type="ndarray")
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    right, below = _opposite(corners, (1, 2), (0, 3)), _opposite(corners, (2, 3), (1, 0))
    chess = squares.reshape(-1, 3)[pairs[:, 0]]
    sides = np.linalg.norm(squares[pairs[:, 0] // 4, 1] - squares[pairs[:, 0] // 4, 0], axis=1)
    nearest = cKDTree(corners.reshape(-1, 3)).query(chess)[0] if len(chess) else np.zeros(0)
    free_m = np.minimum(nearest / math.sqrt(2.0), 0.5 * sides)  # a marker's corner lies on the diagonal
    ids = np.sort([m.id for m in board.markers]) if board.markers else board.first_id + np.arange(len(corners))
    return Geometry(ids, corners, squares, chess, pairs // 4, pairs % 4, free_m, right, below)


def _opposite(corners: Array, edge: tuple[int, int], other: tuple[int, int]) -> NDArray[np.int64]:
    """[N]: the nearest marker whose corners `other` lie straight beyond a marker's corners `edge`, or -1."""
    inward = corners[:, edge[0]] - corners[:, other[0]]  # across the marker, out of its edge
    side = np.linalg.norm(inward, axis=1)
    facing = np.full(len(corners), -1)
    middle, faced = (corners[:, list(pair)].mean(axis=1) for pair in (edge, other))
    for n, near in enumerate(cKDTree(faced).query_ball_point(middle, side * (1.0 + SAME_SHARE))):
        gaps = corners[near][:, list(other)] - corners[n, list(edge)]
        along = gaps[:, 0] @ inward[n] / side[n]
        straight = np.abs(gaps - along[:, None, None] * inward[n] / side[n]).max(axis=(1, 2), initial=0.0)
        fits = (straight < SAME_SHARE * side[n]) & (along > SAME_SHARE * side[n])
        if fits.any():
            facing[n] = np.array(near)[fits][np.argmin(along[fits])]
    return facing


SAME_SHARE = 0.01
"""Of a marker's side: edges that are so nearly in line face one another."""


def frame_in_board(board: Board, frame: BoardFrame) -> Pose:
    """T_board_frame [4, 4]: takes coordinates of the other frame to ours.

    `opencv`: OpenCV 4.6 and later, origin at the top left of the print, y down, z into the board; `opencv_old`: before, and
    Kalibr's, origin at the bottom left, y up, z out of the board. The print is the markers, with the squares of a chessboard.
    Raises CaptureError for another frame of a board whose markers do not lie in its plane.
    """
    if frame == "centre":
        return np.eye(4)
    geometry = board_geometry(board)
    printed = [geometry.corners, geometry.squares[np.unique(geometry.chess_squares)]]
    points = np.concatenate(printed).reshape(-1, 3)
    if np.abs(points[:, 2]).max() > TOUCHING_M:
        raise CaptureError(
            "frame", f"frame {frame} is of a flat board, and this one's markers lie elsewhere: use centre"
        )
    low, high = points.min(axis=0), points.max(axis=0)
    if frame == "opencv":
        return pose(np.diag([1.0, -1.0, -1.0]), np.array([low[0], high[1], 0.0]))
    return pose(np.eye(3), np.array([low[0], low[1], 0.0]))


PREDEFINED = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
"""Names of OpenCV's dictionaries."""
LARGEST = 999
"""The last id of the families' largest dictionaries."""


def predefined_dictionary(name: str) -> "cv2.aruco.Dictionary":
    """OpenCV's dictionary of a name in `PREDEFINED`."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def smallest_dictionary(name: str, last_id: int) -> str:
    """The smallest dictionary of a family that has the id; the first markers of all in a family are the same."""
    family, _, size = name.rpartition("_")
    sizes = ("50", "100", "250", "1000")
    return f"{family}_{next(n for n in sizes if int(n) > last_id)}" if size in sizes else name


def marker_corners(board: Board) -> Array:
    """[N, 4, 3] float64, metres, board frame: corners of each marker as in `Geometry`, by ascending id.

    Sizes are the nominal ones times `board.scale`.
    """
    if board.markers:
        return board.scale * np.array([m.corners for m in sorted(board.markers, key=lambda m: m.id)], np.float64)
    pitch = board.marker_m + board.gap_m
    columns, rows = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    left = columns.ravel() * pitch - 0.5 * (board.columns * pitch - board.gap_m)
    top = 0.5 * (board.rows * pitch - board.gap_m) - rows.ravel() * pitch
    right, bottom = left + board.marker_m, top - board.marker_m
    flat = np.stack([left, top, right, top, right, bottom, left, bottom], axis=1).reshape(-1, 4, 2)
    return np.concatenate([flat, np.zeros((len(flat), 4, 1))], axis=2) * board.scale


def id_words(ids: NDArray[np.int64]) -> str:
    """Ascending ids in words: `3 to 37`, or one by one."""
    if len(ids) > 1 and ids[-1] - ids[0] == len(ids) - 1:
        return f"{ids[0]} to {ids[-1]}"
    last = [f"... {ids[-1]}"] if len(ids) > MOST_SHOWN else []
    return ", ".join([*map(str, ids[:MOST_SHOWN]), *last])


MOST_SHOWN = 12
"""Ids that a message lists."""


def open_dictionary(board: Board, folder: Path | None = None) -> "cv2.aruco.Dictionary":
    """OpenCV's dictionary of the board's markers.

    A name that OpenCV does not know is a file below `folder` in OpenCV's format. Raises CaptureError where there is neither,
    or where the dictionary has fewer markers than the board.
    """
    if board.dictionary in PREDEFINED:
        dictionary = predefined_dictionary(board.dictionary)
    else:
        path = None if folder is None or "/" in board.dictionary else folder / board.dictionary
        if path is None or not path.is_file():
            known = "neither one of OpenCV's (DICT_4X4_50, ...) nor a file beside it"
            raise CaptureError("dictionary", f"board.json names the dictionary {board.dictionary!r}, which is {known}")
        file, dictionary = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ), cv2.aruco.Dictionary()
        if not dictionary.readDictionary(file.root()):
            raise CaptureError(
                "dictionary", f"{path.name} is no dictionary in OpenCV's format (nmarkers, markersize, marker_0)"
            )
    count, needed = len(dictionary.bytesList), int(board_geometry(board).ids[-1]) + 1
    if count < needed:
        raise CaptureError(
            "dictionary",
            f"the dictionary {board.dictionary} has {count} markers, and the board needs {needed}: take a larger one, such as "
            "DICT_4X4_100 or DICT_4X4_1000, or fewer columns and rows",
        )
    return dictionary


MARGIN_M = 0.02
"""Least width of the sheet beside the grid, where ruler and text stand."""
TICK_M = 0.00025
"""Width of the ruler's ticks."""


@dataclass(frozen=True)
class Words:
    """One line of text that starts at (x_m, y_m) in the board frame, turned by `turn_deg` anticlockwise."""

    x_m: float
    y_m: float
    height_m: float
    words: str
    turn_deg: int = 0


@dataclass(frozen=True, eq=False)
class PrintLayout:
    """A sheet around the origin of the board frame: x right, y up, metres, nominal sizes.

    Black rectangles, float64: left, bottom, right, top. markers [N, 4] do not overlap; seams [S, 4] are black of the markers
    again, across the edges between two of those, so that no renderer of vectors shows a line there; ruler [M, 4] may overlap.
    arrow [3, 2] float64 is a black triangle that points up the print.
    """

    width_m: float
    height_m: float
    markers: Array
    seams: Array
    ruler: Array
    arrow: Array
    words: tuple[Words, ...]


def lay_out_print(board: Board) -> PrintLayout:
    """The sheet of a board. A measured ruler is left aside: a print is made at nominal size.

    Raises InputError where the ruler is longer than the sheet is high, CaptureError for a dictionary that cannot be used.
    """
    geometry = board_geometry(board.model_copy(update={"measured_ruler_m": None}))
    black = [*marker_cells(board), *np.ones((len(geometry.squares), 1, 1), np.bool_)]
    placed = [upright(*pair) for pair in zip(black, [*geometry.corners, *geometry.squares], strict=True)]
    markers, seams = (np.concatenate([_black_runs(*each, turned) for each in placed]) for turned in (False, True))
    print_width = 2.0 * float(np.abs(markers[:, [0, 2]]).max())
    width = max(board.width_m, print_width + 2 * MARGIN_M)
    height = board.height_m
    if board.ruler_m > height - 0.02:
        raise InputError(
            f"ruler_m is {board.ruler_m:g}, and the sheet is {height:g} m high: make it at most {height - 0.02:g}"
        )
    margin = 0.5 * (width - print_width)
    ruler_x, top = -0.5 * width + 0.25 * margin, 0.5 * height - 0.01
    ruler, figures = _ruler(ruler_x, top, board.ruler_m)
    arrow_y = top - board.ruler_m - 0.035
    arrow = np.array([ruler_x + 0.005, arrow_y]) + np.array([[-0.005, 0.0], [0.005, 0.0], [0.0, 0.012]])
    words = (Words(ruler_x, arrow_y - 0.006, 0.004, "TOP"), *figures, *_instructions(board, 0.5 * width, margin, top))
    return PrintLayout(width, height, markers, seams, ruler, arrow, words)


def marker_cells(board: Board) -> NDArray[np.bool_]:
    """[N, n, n] bool: the black cells of each marker with its border, top row of OpenCV's picture first, by ascending id."""
    dictionary = open_dictionary(board)
    side, border = dictionary.markerSize + 2 * board.border_bits, board.border_bits
    ids = board_geometry(board).ids.tolist()
    return np.stack([cv2.aruco.generateImageMarker(dictionary, n, side, borderBits=border) == 0 for n in ids])


def upright(cells: NDArray[np.bool_], corners: Array) -> tuple[NDArray[np.bool_], float, float, float]:
    """(cells [n, n] as they lie on the sheet, x of the left edge, y of the upper edge, side) of a marker at corners [4, 3].

    Raises InputError where its edges do not run along the sheet's.
    """
    first = int(np.lexsort((np.round(corners[:, 0], 6), -np.round(corners[:, 1], 6)))[0])
    turned = np.roll(corners, -first, axis=0)
    side = float(turned[1, 0] - turned[0, 0])
    level = np.array([*turned[0, :2], 0.0])
    flat = level + np.array([[0, 0, 0], [side, 0, 0], [side, -side, 0], [0, -side, 0]])
    if np.abs(flat - turned).max() > TOUCHING_M:
        where = ", ".join(f"({x:g}, {y:g}, {z:g})" for x, y, z in corners)
        raise InputError(f"the marker at {where} is turned, or not in the plane of the board: a sheet cannot show it")
    return np.rot90(cells, first), float(turned[0, 0]), float(turned[0, 1]), side


def _black_runs(cells: NDArray[np.bool_], left: float, top: float, whole: float, turned: bool) -> Array:
    """[N, 4]: runs of black cells along rows, or along columns where `turned`."""
    side, runs = whole / len(cells), []
    for n, line in enumerate(cells.T if turned else cells):
        for start, stop in np.flatnonzero(np.diff(line, prepend=False, append=False)).reshape(-1, 2).tolist():
            a, b, c, d = (n, start, n + 1, stop) if turned else (start, n, stop, n + 1)
            runs.append([left + a * side, top - d * side, left + c * side, top - b * side])
    return np.array(runs)


def _ruler(x: float, top: float, length_m: float) -> tuple[Array, list[Words]]:
    """Ticks every millimetre, downwards from `top`; the two ends are the centres of the first and last tick."""
    count = math.floor(length_m * 1000 + 1e-6)
    marks = [(n / 1000, 0.003 if n % 5 else 0.0045 if n % 10 else 0.006) for n in range(count + 1)]
    marks.append((length_m, 0.009))
    marks[0] = (0.0, 0.009)
    half = 0.5 * TICK_M
    ticks = [[x, top - at - half, x + reach, top - at + half] for at, reach in marks]
    ticks.append([x - half, top - length_m - half, x + half, top + half])
    figures = [Words(x + 0.0065, top - n / 1000 - 0.001, 0.0022, str(n)) for n in range(10, count, 10)]
    figures.append(Words(x, top - length_m - 0.005, 0.003, f"{length_m * 1000:g} mm"))
    return np.array(ticks), figures


def _instructions(board: Board, right: float, margin: float, top: float) -> list[Words]:
    """Lines that run downwards in the right margin, outer line last."""
    size = np.ptp(board_geometry(board.model_copy(update={"measured_ruler_m": None})).corners, axis=(0, 1)) * 1000
    lines = [
        f"Verso marker board: {board.dictionary}, ids {id_words(board_geometry(board).ids)}, {board.words}, "
        f"{size[0]:g} x {size[1]:g} mm over all markers.",
        "Print at 100 % (no scaling, no 'fit to page'); glue to a flat, stiff plate.",
        f"Measure the ruler at the left. Are its end lines {board.ruler_m * 1000:g} mm apart? If not, put the length measured,",
        f'in metres, into board.json, e.g. "measured_ruler_m": {board.ruler_m * 0.9945:.4f}, and all lengths are scaled by it.',
    ]
    high = min(0.003, 0.1 * margin)
    x = right - margin + 0.35 * margin
    return [Words(x + i * 1.5 * high, top, high, line, -90) for i, line in enumerate(reversed(lines))]


FLAT = 1e-4
"""Points whose thickness is less than this share of their extent are a plane: a board's print is flatter than that."""


def first_poses(points: Array, rays: Array) -> list[Pose]:
    """T_points_cam of the one or two poses that see points [K, 3] along rays [K, 2]: a plane looks alike from both (IPPE).

    Points that lie in no plane have one pose (SQPnP, Terzakis and Lourakis 2020).
    """
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    flat, T_points_plane = bool(extents[2] <= FLAT * extents[0]), np.eye(4)
    if flat and points[:, 2].any():
        T_points_plane = pose(axes.T * np.linalg.det(axes), middle)
    kind = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    return [T_points_plane @ invert(T) for T in opencv_poses(transform(invert(T_points_plane), points), rays, kind)]


def opencv_poses(points: Array, rays: Array, kind: int) -> list[Pose]:
    """The poses [4, 4] that take points [K, 3] to the camera that sees them along rays [K, 2], the likeliest first."""
    count, turns, shifts, _ = cv2.solvePnPGeneric(points[:, None], rays[:, None], np.eye(3), None, flags=kind)
    matrices = [cv2.Rodrigues(turn)[0].astype(np.float64) for turn in turns[:count]]
    poses = [pose(R, shift.ravel().astype(np.float64)) for R, shift in zip(matrices, shifts[:count], strict=True)]
    return [T for T in poses if np.isfinite(T).all()]
