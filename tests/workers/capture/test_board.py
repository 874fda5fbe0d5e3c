"""The marker board: its layout against OpenCV's, the sheet that is printed, and the body that is simulated."""

import io
import re

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.errors import CaptureError, InputError
from schemas.job.captures import Board
from workers.capture.board import frame_in_board, lay_out_print, marker_cells, marker_corners, nominal, open_dictionary
from workers.capture.sheets import A4_M, EDGE_M, OVERLAP_M, board_pdf, board_png, tile_sheet, tiled_pdf
from workers.capture.simulate.photograph import THICKNESS_M, board_body
from workers.geometry.frames import transform

BOARD = Board()
SMALL = Board(dictionary="DICT_6X6_250", columns=3, rows=4, marker_m=0.031, gap_m=0.011, width_m=0.2, first_id=17)


# ---------------------------------------------------------------------------------------------- layout


def test_opencvs_own_board_lies_on_ours():
    """Origin at the grid's centre and z out of the print; OpenCV's is at the top left, y down, z into the board."""
    for board in (BOARD, Board(columns=4, rows=3, marker_m=0.05, gap_m=0.01)):
        grid = cv2.aruco.GridBoard((board.columns, board.rows), board.marker_m, board.gap_m, open_dictionary(board))
        theirs = np.array(grid.getObjPoints(), dtype=np.float64).reshape(-1, 3)
        ours = marker_corners(board)
        assert transform(frame_in_board(board, "opencv"), theirs) == pytest.approx(ours.reshape(-1, 3), abs=1e-7)
        assert np.abs(ours.mean(axis=(0, 1))).max() < 1e-12
        old = frame_in_board(board, "opencv_old")  # before 4.6: origin at the bottom left, z out of the board
        assert old[:3, 3] == pytest.approx(ours.reshape(-1, 3).min(axis=0)) and np.array_equal(old[:3, :3], np.eye(3))
    assert marker_corners(BOARD)[0, 0] == pytest.approx([-0.27, 0.19, 0.0])
    assert marker_corners(Board(measured_ruler_m=0.204)) == pytest.approx(marker_corners(BOARD) * 1.02)


def test_dictionary_that_does_not_exist_or_is_too_small_is_refused():
    with pytest.raises(CaptureError, match="neither one of OpenCV's"):
        open_dictionary(Board(dictionary="DICT_9X9"))
    with pytest.raises(CaptureError, match="has 50 markers, and the board needs 70"):
        open_dictionary(Board(columns=10, rows=7, width_m=1.0, height_m=1.0))


# ---------------------------------------------------------------------------------------------- the sheet


def test_the_black_rectangles_are_the_black_cells_of_the_markers():
    layout = lay_out_print(BOARD)
    left, bottom, right, top = layout.markers.T
    for cells, corners in zip(marker_cells(BOARD), nominal(BOARD), strict=True):
        side = BOARD.marker_m / len(cells)
        for row, column in np.ndindex(cells.shape):
            x, y = corners[0, 0] + (column + 0.5) * side, corners[0, 1] - (row + 0.5) * side
            assert ((left < x) & (x < right) & (bottom < y) & (y < top)).any() == cells[row, column]
    measured = lay_out_print(BOARD.model_copy(update={"measured_ruler_m": 0.19}))  # a print is made at nominal size
    assert np.array_equal(measured.markers, layout.markers)


def test_ruler_words_and_arrow_are_on_the_sheet_and_clear_of_the_markers():
    layout = lay_out_print(BOARD)
    left, bottom, right, top = layout.ruler.T
    ends = 0.5 * (bottom + top)[np.isclose(right - left, (right - left).max())]
    assert ends.max() - ends.min() == pytest.approx(0.2)
    quiet = 0.01  # a cell of a marker: ArUco needs as much white around it
    assert right.max() < layout.markers[:, 0].min() - quiet
    assert left.min() > -0.5 * layout.width_m and top.max() < 0.5 * layout.height_m
    for words in layout.words:
        length = 0.75 * words.height_m * len(words.words)  # more than any line of Helvetica takes
        x, y = (words.x_m + length, words.y_m) if words.turn_deg == 0 else (words.x_m, words.y_m - length)
        assert abs(x) < 0.3 and abs(y) < 0.2
        assert x < layout.markers[:, 0].min() or words.x_m > layout.markers[:, 2].max()
    assert layout.arrow[2, 1] > layout.arrow[:2, 1].max()
    assert sum("measured_ruler_m" in words.words for words in layout.words) == 1


def test_a_sheet_is_wide_enough_for_its_ruler_or_refused():
    assert lay_out_print(Board(columns=2, rows=3, width_m=0.14, height_m=0.3)).width_m == pytest.approx(0.18)
    with pytest.raises(InputError, match="ruler_m"):
        lay_out_print(Board(rows=2, height_m=0.15))
    with pytest.raises(InputError, match="too many pixels"):
        board_png(BOARD, 10_000.0)


@pytest.mark.parametrize(("board", "dpi"), [(BOARD, 40.0), (SMALL, 101.6)])
def test_every_marker_of_the_png_is_found_where_the_layout_has_it(board, dpi):
    image = Image.open(io.BytesIO(board_png(board, dpi)))
    assert image.info["dpi"][0] == pytest.approx(dpi, abs=0.02)
    px_per_m, layout = round(image.info["dpi"][0] / 0.0254), lay_out_print(board)
    assert image.size == (np.ceil(layout.width_m * px_per_m - 1e-6), np.ceil(layout.height_m * px_per_m - 1e-6))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(open_dictionary(board), parameters).detectMarkers(np.asarray(image))
    assert sorted(ids.ravel()) == list(range(board.first_id, board.first_id + board.columns * board.rows))
    for found, number in zip(corners, ids.ravel(), strict=True):
        true = nominal(board)[int(number) - board.first_id, :, :2]
        pixels = (true * [1, -1] + [0.5 * layout.width_m, 0.5 * layout.height_m]) * px_per_m
        assert np.abs(found[0] + 0.5 - pixels).max() < 0.2


def test_black_and_ruler_of_the_png_have_their_true_size():
    """What a pixel is cut by is drawn in part; the two end ticks of the ruler, 0.25 mm wide, are 200 mm apart."""
    picture = np.asarray(Image.open(io.BytesIO(board_png(BOARD, 127.0))))  # 5 pixels a millimetre
    grid = picture[:, 150:2850].astype(np.float64)
    black = marker_cells(BOARD).sum() * (BOARD.marker_m / 6) ** 2
    assert (255 - grid).sum() / 255 / 5000**2 == pytest.approx(black, rel=1e-3)
    rows = np.flatnonzero(picture[:1058, round((0.0075 + 0.0085) * 5000)] < 128)  # only the end ticks reach so far
    assert rows.max() - rows.min() + 1 == pytest.approx(1000 + 1.25, abs=1.0)


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
    found = np.array([[float(x) for x in match[:4]] for match in RECT.findall(page) if match[4] == b"f*"])
    corner = found[:, :2] + moves[0] + moves[1]  # the first is the library's own
    return np.concatenate([corner, corner + found[:, 2:]], axis=1) * POINT_M


def test_the_pdf_has_the_size_of_the_board_and_its_rectangles_and_is_not_to_be_scaled():
    data, layout = board_pdf(BOARD), lay_out_print(BOARD)
    assert boxes(data) == [pytest.approx([0, 0, 0.6, 0.4], abs=1e-6)]
    true = np.concatenate([layout.markers, layout.ruler]) + np.array([0.3, 0.2, 0.3, 0.2])
    assert rectangles(pages(data)[0]) == pytest.approx(true, abs=1e-6)
    assert b"/PrintScaling /None" in data and b"Print at 100 %" in data and b"(TOP)" in data
    assert data == board_pdf(BOARD)


def test_the_tiles_cover_the_sheet_once_and_fit_their_pages():
    for board in (BOARD, Board(columns=3, rows=2, height_m=0.3), Board(marker_m=0.25, columns=2, rows=1)):
        layout = lay_out_print(board)
        page, tiles = tile_sheet(board, layout)
        assert sorted(page) == sorted(A4_M)
        area = sum((tile.right - tile.left) * (tile.top - tile.bottom) for tile in tiles)
        assert area == pytest.approx(layout.width_m * layout.height_m)
        for tile in tiles:
            assert tile.right - tile.left + 2 * (OVERLAP_M + EDGE_M) <= page[0] + 1e-9
            assert tile.top - tile.bottom + 2 * (OVERLAP_M + EDGE_M) <= page[1] + 1e-9
    layout = lay_out_print(BOARD)
    for tile in tile_sheet(BOARD, layout)[1]:  # no seam cuts a marker or the ruler
        for x in (tile.left, tile.right):
            assert not ((layout.markers[:, 0] < x - 1e-6) & (x + 1e-6 < layout.markers[:, 2])).any()
        for y in (tile.bottom, tile.top):
            crossed = np.concatenate([layout.markers, layout.ruler])
            assert not ((crossed[:, 1] < y - 1e-6) & (y + 1e-6 < crossed[:, 3])).any()


def test_the_pages_put_together_give_the_board():
    """Each page's print, cut at its marks and moved to its tile, is the same sheet."""
    data, layout = tiled_pdf(BOARD), lay_out_print(BOARD)
    page, tiles = tile_sheet(BOARD, layout)
    assert len(pages(data)) == len(tiles) == len(boxes(data)) == 8
    true = np.concatenate([layout.markers, layout.ruler])
    for number, (content, box, tile) in enumerate(zip(pages(data), boxes(data), tiles, strict=True)):
        assert box == pytest.approx([0, 0, *page], abs=1e-6)
        clip = next(m for m in RECT.findall(content) if m[4] == b"W")  # in board coordinates: before the page's shift
        size = [tile.right - tile.left + 2 * OVERLAP_M, tile.top - tile.bottom + 2 * OVERLAP_M]
        expected = [tile.left - OVERLAP_M, tile.bottom - OVERLAP_M, *size]
        assert [float(x) * POINT_M for x in clip[:4]] == pytest.approx(expected, abs=1e-6)
        middle = 0.5 * np.array([tile.left + tile.right, tile.bottom + tile.top])
        assert rectangles(content) == pytest.approx(true + np.tile(0.5 * np.array(page) - middle, 2), abs=1e-6)
        assert f"page {number + 1} of 8".encode() in content and f"column {number % 4 + 1} of 4".encode() in content
        marks = re.findall(rb"^n ([-0-9.]+) ([-0-9.]+) m ([-0-9.]+) ([-0-9.]+) l S", content, re.M)
        assert len(marks) == 8


# ---------------------------------------------------------------------------------------------- the body


@pytest.mark.parametrize(
    "board",
    [BOARD, Board(columns=3, rows=2, dictionary="DICT_6X6_250", first_id=17, width_m=0.3, height_m=0.2, gap_m=0.011)],
)
def test_the_print_of_the_body_is_opencvs_picture_of_the_board(board):
    """OpenCV draws its GridBoard with the first marker at the top left, as ours has it."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    ids, px_per_m = np.arange(board.columns * board.rows) + board.first_id, 2000
    theirs = cv2.aruco.GridBoard((board.columns, board.rows), board.marker_m, board.gap_m, dictionary, ids)
    pitch, bits = board.marker_m + board.gap_m, dictionary.markerSize + 2
    width, height = board.columns * pitch - board.gap_m, board.rows * pitch - board.gap_m
    size = (round(width * px_per_m), round(height * px_per_m))
    picture = theirs.generateImage(size, marginSize=0, borderBits=1)
    middles = (np.arange(bits) + 0.5) / bits * board.marker_m
    x, y = np.meshgrid(*((np.arange(n)[:, None] * pitch + middles).ravel() for n in (board.columns, board.rows)))
    black = picture[(y * px_per_m).astype(int), (x * px_per_m).astype(int)] < 128
    ink = board_body(board).parts[1]
    corners = ink.vertices[ink.faces][:, :, :2]
    low, high = corners.min(axis=1), corners.max(axis=1)
    points = np.stack([x - 0.5 * width, 0.5 * height - y], axis=-1).reshape(-1, 2)
    assert np.array_equal([((low < p) & (p < high)).all(axis=1).any() for p in points], black.ravel())
    area = trimesh.Trimesh(ink.vertices, ink.faces, process=False).area
    assert area == pytest.approx(black.sum() * (board.marker_m / bits) ** 2)


def test_the_body_is_closed_and_its_faces_look_outwards():
    shape = board_body(BOARD)
    mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=True)
    assert mesh.volume == pytest.approx(0.6 * 0.4 * THICKNESS_M)
    assert mesh.bounds.tolist() == pytest.approx(np.array([[-0.3, -0.2, -THICKNESS_M], [0.3, 0.2, 0.0]]))
    top = mesh.triangles_center[:, 2] == 0.0
    assert mesh.area_faces[top].sum() == pytest.approx(0.24)
    assert (mesh.face_normals[top][:, 2] > 0.999).all()
    large = board_body(Board(measured_ruler_m=0.204))  # a print that is too large is larger in every length
    assert np.allclose(large.vertices[:, :2], 1.02 * shape.vertices[:, :2], atol=1e-15)
