"""The PDF, read back from its uncompressed content: page sizes, rectangles and what the pages show together."""

import re

import numpy as np
import pytest

from schemas.job.captures import Board
from workers.capture.board.layout import lay_out_print
from workers.capture.board.sheets import A4_M, EDGE_M, OVERLAP_M, board_pdf, tile_sheet, tiled_pdf

POINT_M = 0.0254 / 72
RECT = re.compile(rb"^n ([-0-9.]+) ([-0-9.]+) ([-0-9.]+) ([-0-9.]+) re (f\*|W)", re.M)
MOVE = re.compile(rb"^1 0 0 1 ([-0-9.]+) ([-0-9.]+) cm", re.M)


def pages(data: bytes) -> list[bytes]:
    """The content stream of each page."""
    return re.findall(rb"stream\r?\n(.*?)endstream", data, re.S)


def boxes(data: bytes) -> list[list[float]]:
    return [[float(x) * POINT_M for x in box.split()] for box in re.findall(rb"/MediaBox \[ ([^\]]*)\]", data)]


def rectangles(page: bytes) -> np.ndarray:
    """[N, 4] left, bottom, right, top on the paper, metres, of what is filled."""
    moves = [np.array([float(x), float(y)]) for x, y in MOVE.findall(page)]
    origin = moves[0] + moves[1]  # the first is the library's own
    found = np.array([[float(x) for x in match[:4]] for match in RECT.findall(page) if match[4] == b"f*"])
    corner = found[:, :2] + origin
    return np.concatenate([corner, corner + found[:, 2:]], axis=1) * POINT_M


def test_the_sheet_has_the_size_of_the_board_and_its_rectangles():
    data = board_pdf(Board())
    assert boxes(data) == [pytest.approx([0, 0, 0.6, 0.4], abs=1e-6)]
    layout = lay_out_print(Board())
    drawn = rectangles(pages(data)[0])
    true = np.concatenate([layout.markers, layout.ruler]) + np.array([0.3, 0.2, 0.3, 0.2])
    assert drawn == pytest.approx(true, abs=1e-6)


def test_the_sheet_is_not_to_be_scaled_and_says_so():
    data = board_pdf(Board())
    assert b"/PrintScaling /None" in data and b"Print at 100 %" in data and b"(TOP)" in data


def test_the_same_board_has_the_same_bytes():
    assert board_pdf(Board()) == board_pdf(Board()) and tiled_pdf(Board()) == tiled_pdf(Board())


@pytest.mark.parametrize(
    "board", [Board(), Board(columns=3, rows=2, height_m=0.3), Board(marker_m=0.25, columns=2, rows=1)]
)
def test_the_tiles_cover_the_sheet_once_and_fit_their_pages(board):
    layout = lay_out_print(board)
    page, tiles = tile_sheet(board, layout)
    assert sorted(page) == sorted(A4_M)
    area = sum((tile.right - tile.left) * (tile.top - tile.bottom) for tile in tiles)
    assert area == pytest.approx(layout.width_m * layout.height_m)
    for tile in tiles:
        assert tile.right - tile.left + 2 * (OVERLAP_M + EDGE_M) <= page[0] + 1e-9
        assert tile.top - tile.bottom + 2 * (OVERLAP_M + EDGE_M) <= page[1] + 1e-9


def test_no_seam_cuts_a_marker_or_the_ruler():
    layout = lay_out_print(Board())
    _, tiles = tile_sheet(Board(), layout)
    for tile in tiles:
        for x in (tile.left, tile.right):
            assert not ((layout.markers[:, 0] < x - 1e-6) & (x + 1e-6 < layout.markers[:, 2])).any()
        for y in (tile.bottom, tile.top):
            crossed = np.concatenate([layout.markers, layout.ruler])
            assert not ((crossed[:, 1] < y - 1e-6) & (y + 1e-6 < crossed[:, 3])).any()


def test_the_pages_put_together_give_the_board():
    """Each page's print, cut at its marks and moved to its tile, is the same sheet."""
    data = tiled_pdf(Board())
    layout = lay_out_print(Board())
    page, tiles = tile_sheet(Board(), layout)
    assert len(pages(data)) == len(tiles) == len(boxes(data)) == 8
    true = np.concatenate([layout.markers, layout.ruler])
    for content, box, tile in zip(pages(data), boxes(data), tiles, strict=True):
        assert box == pytest.approx([0, 0, *page], abs=1e-6)
        clip = next(m for m in RECT.findall(content) if m[4] == b"W")
        corner = np.array([float(x) for x in clip[:2]]) * POINT_M  # in board coordinates: before the page's shift
        assert corner == pytest.approx([tile.left - OVERLAP_M, tile.bottom - OVERLAP_M], abs=1e-6)
        assert [float(x) * POINT_M for x in clip[2:4]] == pytest.approx(
            [tile.right - tile.left + 2 * OVERLAP_M, tile.top - tile.bottom + 2 * OVERLAP_M], abs=1e-6
        )
        middle = 0.5 * np.array([tile.left + tile.right, tile.bottom + tile.top])
        shift = np.tile(0.5 * np.array(page) - middle, 2)
        assert rectangles(content) == pytest.approx(true + shift, abs=1e-6)


def test_every_page_says_where_it_belongs_within_what_printers_print():
    for number, content in enumerate(pages(tiled_pdf(Board())), start=1):
        assert f"page {number} of 8".encode() in content
        assert f"column {(number - 1) % 4 + 1} of 4".encode() in content
    lines = re.findall(rb"^n ([-0-9.]+) ([-0-9.]+) m ([-0-9.]+) ([-0-9.]+) l S", pages(tiled_pdf(Board()))[0], re.M)
    assert len(lines) == 8
