"""Detection of a board's markers in a photograph, by OpenCV's ArucoDetector, with corners refined along their edges."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.capture.view import Detection
from schemas.job.captures import Board
from workers.capture.board.layout import PREDEFINED
from workers.capture.edges import refine_corners

MIN_PERIMETER = 0.01
"""Smallest perimeter of a marker over the larger side of the image: 19 px of 1920, below which bits cannot be read."""

CLEAR_PERIMETER = 0.06
SEVERAL = 4
"""Another dictionary is named for so many markers of at least this size: fewer may be chance."""


def detect_markers(
    rgb: NDArray[np.uint8], board: Board, dictionary: "cv2.aruco.Dictionary", number: int = 0
) -> Detection:
    """The board's markers in an image [H, W, 3]; ids that are not on the board, or that are seen twice, are dropped."""
    gray: NDArray[np.uint8] = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)
    quads, found, _ = _detector(dictionary).detectMarkers(gray)
    ids = np.zeros(0, np.int64) if found is None else found.ravel().astype(np.int64)
    kept, dropped = _usable(ids, board)
    corners = np.array([quads[k][0] for k in kept], dtype=np.float64).reshape(-1, 4, 2)
    corners = refine_corners(gray, corners, dictionary.markerSize + 2) + 0.5
    corners.setflags(write=False)
    return Detection(number, ids[kept], corners, dropped)


def other_dictionaries(rgb: NDArray[np.uint8]) -> str:
    """What the image holds in place of the board's markers, in words: other dictionaries, or mirrored markers; or nothing.

    Takes a second or so: for the message about a capture in which no marker was found.
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    best, most = "", SEVERAL - 1
    for picture, how in ((gray, ""), (np.ascontiguousarray(gray[:, ::-1]), ", mirrored")):
        for name in PREDEFINED:
            if name.endswith(("_50", "_100", "_250")) or name != name.upper():
                continue  # the first markers of the dictionary of 1000, or a second name
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
            _, ids, _ = _detector(dictionary, CLEAR_PERIMETER).detectMarkers(picture)
            if ids is not None and len(ids) > most:
                best, most = (
                    f"the image holds {len(ids)} markers of {_smallest(name, int(np.median(ids)))}{how}",
                    len(ids),
                )
    return best


def _smallest(name: str, usual_id: int) -> str:
    """The smallest dictionary of the family that has the id; a few ids may be misread."""
    family, _, size = name.rpartition("_")
    return f"{family}_{next(n for n in (50, 100, 250, 1000) if n > usual_id)}" if size == "1000" else name


def _detector(dictionary: "cv2.aruco.Dictionary", min_perimeter: float = MIN_PERIMETER) -> "cv2.aruco.ArucoDetector":
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    settings.minMarkerPerimeterRate = min_perimeter
    return cv2.aruco.ArucoDetector(dictionary, settings)


def _usable(ids: NDArray[np.int64], board: Board) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """(indices of the ids that are used, by ascending id; what is dropped, in words)."""
    last = board.first_id + board.columns * board.rows - 1
    values, counts = np.unique(ids, return_counts=True)
    on_board = (values >= board.first_id) & (values <= last)
    dropped = [f"marker {value} is not on the board ({board.first_id} to {last})" for value in values[~on_board]]
    dropped += [
        f"marker {value} was seen {count} times"
        for value, count in zip(values[on_board], counts[on_board], strict=True)
        if count > 1
    ]
    kept = np.flatnonzero(np.isin(ids, values[on_board & (counts == 1)]))
    return kept[np.argsort(ids[kept], kind="stable")], tuple(dropped)
