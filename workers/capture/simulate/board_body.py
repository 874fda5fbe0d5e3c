"""The printed board as geometry: every cell of every marker is a face, so that its edges are exact at any resolution."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.job.captures import Board
from schemas.scene.shape import Material, Part, Shape
from workers.capture.board.layout import marker_corners, open_dictionary

THICKNESS_M = 0.005
"""Of the board below its print: foam board [assumed]."""

PAPER, INK = (0.91, 0.91, 0.90, 1.0), (0.20, 0.20, 0.21, 1.0)
"""sRGB of paper and of a laser printer's black: 80 % and 3 % of the light [assumed]."""

ROUGHNESS = 1.0


def board_body(board: Board) -> Shape:
    """A closed box in the board frame, metres, its print at z = 0; sizes are those of `marker_corners`.

    Faces share their vertices along every edge of the print, so that no view shows a gap between them.
    """
    across, up, ink = _cells(board)
    vertices, top = _grid(across, up)
    quads, black = top.reshape(-1, 4), ink.ravel()
    sides, low = _sides(vertices, len(across), len(up))
    paper = np.concatenate([quads[~black], sides])
    all_vertices = frozen_array(np.concatenate([vertices, low]))
    return Shape(
        (
            Part("paper", all_vertices, _triangles(paper), Material(PAPER, roughness=ROUGHNESS)),
            Part("ink", all_vertices, _triangles(quads[black]), Material(INK, roughness=ROUGHNESS)),
        ),
        closed=True,
    )


def marker_bits(board: Board) -> NDArray[np.bool_]:
    """[M, n, n] bool: the black cells of each marker with its border, row 0 at the top of the print."""
    dictionary = open_dictionary(board)
    side = dictionary.markerSize + 2
    count = board.columns * board.rows
    images = [cv2.aruco.generateImageMarker(dictionary, board.first_id + m, side) for m in range(count)]
    return np.stack(images) < 128


def _cells(board: Board) -> tuple[Array, Array, NDArray[np.bool_]]:
    """(x of the grid lines ascending [X], y of the grid lines ascending [Y], black cells [Y - 1, X - 1])."""
    bits = marker_bits(board)
    side = bits.shape[1]
    corners = marker_corners(board)[..., :2].reshape(board.rows, board.columns, 4, 2)
    edges = np.arange(side + 1) / side
    left, right = corners[0, :, 0, 0], corners[0, :, 1, 0]
    top, bottom = corners[:, 0, 0, 1], corners[:, 0, 3, 1]
    half = 0.5 * board.scale * np.array([board.width_m, board.height_m])
    x = (left[:, None] * (1.0 - edges) + right[:, None] * edges).ravel()
    y = (top[:, None] * (1.0 - edges) + bottom[:, None] * edges).ravel()
    across, up = np.unique([-half[0], *x, half[0]]), np.unique([-half[1], *y, half[1]])
    ink = np.zeros((len(up) - 1, len(across) - 1), np.bool_)
    for row in range(board.rows):
        for column in range(board.columns):
            i = int(np.searchsorted(up, y[row * (side + 1) + side]))
            j = int(np.searchsorted(across, x[column * (side + 1)]))
            ink[i : i + side, j : j + side] = bits[row * board.columns + column][::-1]
    return across, up, ink


def _grid(across: Array, up: Array) -> tuple[Array, NDArray[np.int32]]:
    """(vertices [Y * X, 3] at z = 0, the four corners [Y - 1, X - 1, 4] of each cell counter-clockwise from above)."""
    y, x = np.meshgrid(up, across, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    number = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    return vertices, np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=2)


def _sides(vertices: Array, columns: int, rows: int) -> tuple[NDArray[np.int32], Array]:
    """(quads of the walls and of the underside, the vertices [R, 3] below the rim that they need)."""
    number = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    low = vertices[rim] - [0.0, 0.0, THICKNESS_M]
    below = len(vertices) + np.arange(len(rim), dtype=np.int32)
    after, after_below = np.roll(rim, -1), np.roll(below, -1)
    walls = np.stack([rim, below, after_below, after], axis=1)
    a, b, c = 0, columns - 1, columns - 1 + rows - 1
    d = c + columns - 1
    underside = below[[a, d, c, b]][None, :]
    return np.concatenate([walls, underside]), low


def _triangles(quads: NDArray[np.int32]) -> NDArray[np.int32]:
    """[2 Q, 3] of quads [Q, 4]."""
    return frozen_array(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), np.int32)
