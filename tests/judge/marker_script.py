"""The script that every lab writes for photographs of a marker board: OpenCV's markers, one solvePnP a view.

It is written against OpenCV's documentation and the layout of a capture's folder alone, and shares no code with what it is
compared with. Poses are T_board_cam: camera to board, board frame as in board.json (origin at the middle of the
print, x along the rows, y up the print, z out of it), metres.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

REFINEMENTS = {"default": cv2.aruco.CORNER_REFINE_NONE, "SUBPIX": cv2.aruco.CORNER_REFINE_SUBPIX}
"""Variants of the script by the detector's `cornerRefinementMethod`; every other parameter is OpenCV's default."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """What the script reads of a capture's folder: K [3, 3] with pixel centres at 0, lens [N], and the board's corners by id.

    `corners_m` maps a marker's id to its corners [4, 3], clockwise from the upper left of the print.
    """

    path: Path
    K: NDArray[np.float64]
    lens: NDArray[np.float64]
    dictionary: str
    corners_m: Mapping[int, NDArray[np.float64]]

    def numbers(self) -> list[int]:
        """Numbers of the views."""
        return sorted(int(file.stem.removeprefix("rgb_")) for file in self.path.glob("rgb_*.png"))

    def image(self, number: int) -> NDArray[np.uint8]:
        """[H, W] uint8."""
        pixels = cv2.imread(str(self.path / f"rgb_{number:05d}.png"), cv2.IMREAD_GRAYSCALE)
        return np.asarray(pixels, np.uint8)


def read_photographs(path: Path) -> Photographs:
    """The folder of a capture with a grid of markers and registered depth."""
    camera, board = (json.loads((path / name).read_bytes()) for name in ("camera.json", "board.json"))
    shift = float(camera["pixel_centre"])
    K = np.array([[camera["fx"], 0, camera["cx"] - shift], [0, camera["fy"], camera["cy"] - shift], [0, 0, 1]])
    scale = (board["measured_ruler_m"] or board["ruler_m"]) / board["ruler_m"]
    side, pitch = scale * board["marker_m"], scale * (board["marker_m"] + board["gap_m"])
    columns, rows, first = board["columns"], board["rows"], board["first_id"]
    square = side / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    corners = {
        first + row * columns + column: square
        + pitch * np.array([column - (columns - 1) / 2, (rows - 1) / 2 - row, 0.0])
        for row in range(rows)
        for column in range(columns)
    }
    return Photographs(
        path,
        K,
        np.array(camera["distortion"], np.float64),
        board["dictionary"],
        corners,
    )


def estimate_poses(photographs: Photographs, refinement: str) -> dict[int, NDArray[np.float64]]:
    """T_board_cam [4, 4] by view: all corners of a view in one `cv2.solvePnP`; a view without a marker of the board has none."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = REFINEMENTS[refinement]
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, photographs.dictionary))
    detector, poses = cv2.aruco.ArucoDetector(dictionary, settings), {}
    for number in photographs.numbers():
        quads, ids, _ = detector.detectMarkers(photographs.image(number))
        found = [] if ids is None else [(int(i), q[0]) for i, q in zip(ids.ravel(), quads, strict=True)]
        known = [(photographs.corners_m[i], quad) for i, quad in found if i in photographs.corners_m]
        if not known:
            continue
        places, pixels = (np.concatenate(part).astype(np.float64) for part in zip(*known, strict=True))
        done, turn, shift = cv2.solvePnP(places, pixels, photographs.K, photographs.lens)
        if done:
            T_cam_board = np.eye(4)
            T_cam_board[:3, :3], T_cam_board[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            poses[number] = np.asarray(np.linalg.inv(T_cam_board), np.float64)
    return poses
