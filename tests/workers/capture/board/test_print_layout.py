"""The printed sheet: what stands where, and what is refused."""

import numpy as np
import pytest

from schemas.errors import InputError
from schemas.job.captures import Board
from workers.capture.board.layout import lay_out_print, marker_cells, nominal

BOARD = Board()


def black_at(layout, x: float, y: float) -> bool:
    left, bottom, right, top = layout.markers.T
    return bool(((left < x) & (x < right) & (bottom < y) & (y < top)).any())


def test_the_black_rectangles_are_the_black_cells_of_the_markers():
    layout = lay_out_print(BOARD)
    for cells, corners in zip(marker_cells(BOARD), nominal(BOARD), strict=True):
        side = BOARD.marker_m / len(cells)
        for row, column in np.ndindex(cells.shape):
            x, y = corners[0, 0] + (column + 0.5) * side, corners[0, 1] - (row + 0.5) * side
            assert black_at(layout, x, y) == cells[row, column]


def test_a_measured_ruler_does_not_change_the_print():
    measured = lay_out_print(BOARD.model_copy(update={"measured_ruler_m": 0.19}))
    assert np.array_equal(measured.markers, lay_out_print(BOARD).markers)


def test_the_ruler_is_as_long_as_it_says_and_stands_clear_of_the_markers():
    layout = lay_out_print(BOARD)
    left, bottom, right, top = layout.ruler.T
    reach = right - left
    ends = 0.5 * (bottom + top)[np.isclose(reach, reach.max())]
    assert ends.max() - ends.min() == pytest.approx(0.2)
    quiet = 0.01  # a cell of a marker: ArUco needs as much white around it
    assert right.max() < layout.markers[:, 0].min() - quiet
    assert left.min() > -0.5 * layout.width_m and top.max() < 0.5 * layout.height_m


def test_words_and_arrow_are_on_the_sheet_and_clear_of_the_markers():
    layout = lay_out_print(BOARD)
    for words in layout.words:
        length = 0.75 * words.height_m * len(words.words)  # more than any line of Helvetica takes
        x, y = (words.x_m + length, words.y_m) if words.turn_deg == 0 else (words.x_m, words.y_m - length)
        assert abs(x) < 0.3 and abs(y) < 0.2
        assert x < layout.markers[:, 0].min() or words.x_m > layout.markers[:, 2].max()
    assert layout.arrow[2, 1] > layout.arrow[:2, 1].max()
    assert sum("measured_ruler_m" in words.words for words in layout.words) == 1


def test_a_board_without_a_margin_gets_a_wider_sheet():
    tight = Board(columns=2, rows=3, width_m=0.14, height_m=0.3)
    assert lay_out_print(tight).width_m == pytest.approx(0.18)


def test_a_ruler_longer_than_the_sheet_is_refused():
    with pytest.raises(InputError, match="ruler_m"):
        lay_out_print(Board(rows=2, height_m=0.15))
