"""Where the corners of every marker lie on the board, and OpenCV's dictionary of its markers."""

from pathlib import Path

import cv2
import numpy as np

from schemas.base import Array
from schemas.errors import CaptureError
from schemas.job.captures import Board

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
