"""The drawn board, as OpenCV's detector sees it."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from schemas.errors import InputError
from schemas.job.captures import Board
from workers.capture.board.layout import nominal, open_dictionary
from workers.capture.board.sheets import board_png, draw_board

SMALL = Board(dictionary="DICT_6X6_250", columns=3, rows=4, marker_m=0.031, gap_m=0.011, width_m=0.2, first_id=17)


def check_detection(picture: np.ndarray, board: Board, px_per_m: float, size_m: tuple[float, float]) -> None:
    """Every marker is found where the layout has it, to a fifth of a pixel."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(open_dictionary(board), parameters).detectMarkers(picture)
    assert sorted(ids.ravel()) == list(range(board.first_id, board.first_id + board.columns * board.rows))
    for found, number in zip(corners, ids.ravel(), strict=True):
        true = nominal(board)[int(number) - board.first_id, :, :2]
        pixels = (true * [1, -1] + [0.5 * size_m[0], 0.5 * size_m[1]]) * px_per_m
        assert np.abs(found[0] + 0.5 - pixels).max() < 0.2


@pytest.mark.parametrize(("board", "px_per_m"), [(Board(), 1500.0), (Board(), 1777.7), (SMALL, 4001.3)])
def test_every_marker_is_found_at_its_place(board, px_per_m):
    picture = draw_board(board, px_per_m)
    assert picture.shape == tuple(np.ceil(np.array([board.height_m, board.width_m]) * px_per_m - 1e-6))
    check_detection(picture, board, px_per_m, (board.width_m, board.height_m))


def test_the_black_of_a_picture_is_the_black_of_the_markers():
    """By area: what is cut by a pixel is drawn in part."""
    board = Board()
    for px_per_m in (1000.0, 733.3):
        dark = (255 - draw_board(board, px_per_m).astype(np.float64)).sum() / 255 / px_per_m**2
        exact = draw_board(board, 100.0)  # a cell is a pixel
        assert set(np.unique(exact)) == {0, 255}
        assert dark == pytest.approx((exact == 0).sum() * 1e-4, rel=1e-3)


def test_the_png_knows_its_scale_and_shows_all_markers_beside_ruler_and_text():
    image = Image.open(io.BytesIO(board_png(Board(), 100.0)))
    assert image.info["dpi"][0] == pytest.approx(100.0, abs=0.01)
    px_per_m = round(image.info["dpi"][0] / 0.0254)
    assert image.size == (np.ceil(0.6 * px_per_m), np.ceil(0.4 * px_per_m))
    picture = np.asarray(image)
    check_detection(picture, Board(), px_per_m, (0.6, 0.4))
    plain = draw_board(Board(), px_per_m)
    margin = round(0.025 * px_per_m)
    assert np.array_equal(picture[:, margin:-margin], plain[:, margin:-margin])
    assert (picture[:, :margin] < 128).any() and (picture[:, -margin:] < 128).any()


def test_the_ruler_of_the_png_measures_its_length():
    """Rows of the first and last long tick, at 10 pixels a millimetre."""
    picture = np.asarray(Image.open(io.BytesIO(board_png(Board(), 254.0))))
    column = round((0.0075 + 0.0085) * 10_000)  # only the two end ticks reach so far
    rows = np.flatnonzero(picture[:2115, column] < 128)
    assert rows.max() - rows.min() + 1 == pytest.approx(2000 + 2.5, abs=1.0)  # centres 200 mm apart, 0.25 mm wide


def test_a_picture_that_fills_the_memory_is_refused():
    with pytest.raises(InputError, match="too many pixels"):
        board_png(Board(), 10_000.0)
