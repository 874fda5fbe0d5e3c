"""The marker board: its frame and those of others, the corners of its markers, and what is printed beside them."""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.errors import CaptureError, InputError
from schemas.job.captures import Board, BoardFrame
from workers.geometry.frames import pose


def frame_in_board(board: Board, frame: BoardFrame) -> Pose:
    """T_board_frame [4, 4]: takes coordinates of the other frame to ours.

    `opencv`: OpenCV 4.6 and later, origin at the top left of the grid, y down, z into the board; `opencv_old`: before, origin
    at the bottom left, y up, z out of the board.
    """
    width, height = (
        board.scale * (count * (board.marker_m + board.gap_m) - board.gap_m) for count in (board.columns, board.rows)
    )
    if frame == "opencv":
        return pose(np.diag([1.0, -1.0, -1.0]), np.array([-width / 2, height / 2, 0.0]))
    if frame == "opencv_old":
        return pose(np.eye(3), np.array([-width / 2, -height / 2, 0.0]))
    return np.eye(4)


PREDEFINED = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
"""Names of OpenCV's dictionaries."""


def marker_corners(board: Board) -> Array:
    """[M, 4, 3] float64, metres, board frame: top left, top right, bottom right, bottom left of each marker as printed.

    Marker m has the id first_id + m. Sizes are the nominal ones times `board.scale`.
    """
    pitch = board.marker_m + board.gap_m
    columns, rows = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    left = columns.ravel() * pitch - 0.5 * (board.columns * pitch - board.gap_m)
    top = 0.5 * (board.rows * pitch - board.gap_m) - rows.ravel() * pitch
    right, bottom = left + board.marker_m, top - board.marker_m
    flat = np.stack([left, top, right, top, right, bottom, left, bottom], axis=1).reshape(-1, 4, 2)
    return np.concatenate([flat, np.zeros((len(flat), 4, 1))], axis=2) * board.scale


def open_dictionary(board: Board, folder: Path | None = None) -> "cv2.aruco.Dictionary":
    """OpenCV's dictionary of the board's markers.

    A name that OpenCV does not know is a file below `folder` in OpenCV's format. Raises CaptureError where there is neither,
    or where the dictionary has fewer markers than the board.
    """
    if board.dictionary in PREDEFINED:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    else:
        dictionary = _read_dictionary(board.dictionary, folder)
    count, needed = len(dictionary.bytesList), board.first_id + board.columns * board.rows
    if count < needed:
        raise CaptureError(
            "dictionary", f"the dictionary {board.dictionary} has {count} markers, and the board needs {needed}"
        )
    return dictionary


def _read_dictionary(name: str, folder: Path | None) -> "cv2.aruco.Dictionary":
    path = None if folder is None or "/" in name else folder / name
    if path is None or not path.is_file():
        raise CaptureError(
            "dictionary",
            f"board.json names the dictionary {name!r}, which is neither one of OpenCV's (DICT_4X4_50, ...) nor a file beside it",
        )
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    dictionary = cv2.aruco.Dictionary()
    if not dictionary.readDictionary(file.root()):
        raise CaptureError(
            "dictionary", f"{path.name} is no dictionary in OpenCV's format (nmarkers, markersize, marker_0)"
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

    markers [N, 4] and ruler [M, 4] float64 are black rectangles: left, bottom, right, top, which may overlap; arrow [3, 2]
    float64 is a black triangle that points up the print.
    """

    width_m: float
    height_m: float
    markers: Array
    ruler: Array
    arrow: Array
    words: tuple[Words, ...]


def lay_out_print(board: Board) -> PrintLayout:
    """The sheet of a board. A measured ruler is left aside: a print is made at nominal size.

    Raises InputError where the ruler is longer than the sheet is high, CaptureError for a dictionary that cannot be used.
    """
    grid_width = board.columns * board.marker_m + (board.columns - 1) * board.gap_m
    width = max(board.width_m, grid_width + 2 * MARGIN_M)
    height = board.height_m
    if board.ruler_m > height - 0.02:
        raise InputError(
            f"ruler_m is {board.ruler_m:g}, and the sheet is {height:g} m high: make it at most {height - 0.02:g}"
        )
    margin = 0.5 * (width - grid_width)
    ruler_x, top = -0.5 * width + 0.25 * margin, 0.5 * height - 0.01
    markers = [_black_runs(cells, corners) for cells, corners in zip(marker_cells(board), nominal(board), strict=True)]
    ruler, figures = _ruler(ruler_x, top, board.ruler_m)
    arrow_y = top - board.ruler_m - 0.035
    arrow = np.array([ruler_x + 0.005, arrow_y]) + np.array([[-0.005, 0.0], [0.005, 0.0], [0.0, 0.012]])
    words = (Words(ruler_x, arrow_y - 0.006, 0.004, "TOP"), *figures, *_instructions(board, 0.5 * width, margin, top))
    return PrintLayout(width, height, np.concatenate(markers), ruler, arrow, words)


def nominal(board: Board) -> Array:
    """[M, 4, 3] float64: the markers' corners where the print is exact."""
    return marker_corners(board.model_copy(update={"measured_ruler_m": None}))


def marker_cells(board: Board) -> NDArray[np.bool_]:
    """[M, n, n] bool: the black cells of each marker with its border, top row of the print first."""
    dictionary = open_dictionary(board)
    side = dictionary.markerSize + 2
    ids = range(board.first_id, board.first_id + board.columns * board.rows)
    return np.stack([cv2.aruco.generateImageMarker(dictionary, number, side) == 0 for number in ids])


def _black_runs(cells: NDArray[np.bool_], corners: Array) -> Array:
    """[N, 4]: runs of black cells along rows and along columns, so that no renderer shows a seam between two of them."""
    side = (corners[1, 0] - corners[0, 0]) / len(cells)
    left, top = corners[0, :2]
    runs = [(start, row, stop, row + 1) for row, line in enumerate(cells) for start, stop in _runs(line)]
    runs += [(column, start, column + 1, stop) for column, line in enumerate(cells.T) for start, stop in _runs(line)]
    return np.array([[left + a * side, top - d * side, left + c * side, top - b * side] for a, b, c, d in runs])


def _runs(line: NDArray[np.bool_]) -> list[tuple[int, int]]:
    ends = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]])))
    return list(zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True))


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
    last = board.first_id + board.columns * board.rows - 1
    grid = [count * board.marker_m + (count - 1) * board.gap_m for count in (board.columns, board.rows)]
    lines = [
        f"Verso marker board: {board.dictionary}, ids {board.first_id} to {last}, markers {board.marker_m * 1000:g} mm, "
        f"gaps {board.gap_m * 1000:g} mm, grid {grid[0] * 1000:g} x {grid[1] * 1000:g} mm.",
        "Print at 100 % (no scaling, no 'fit to page'); glue to a flat, stiff plate.",
        f"Measure the ruler at the left. Are its end lines {board.ruler_m * 1000:g} mm apart? If not, put the length measured,",
        f'in metres, into board.json, e.g. "measured_ruler_m": {board.ruler_m * 0.9945:.4f}, and all lengths are scaled by it.',
    ]
    size = min(0.003, 0.1 * margin)
    x = right - margin + 0.35 * margin
    return [Words(x + i * 1.5 * size, top, size, line, -90) for i, line in enumerate(reversed(lines))]
