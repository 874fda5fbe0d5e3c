"""The marker board: its layout against OpenCV's, the sheet that is printed, and the body that is simulated."""

import io
import itertools
import re

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.errors import CaptureError, InputError
from schemas.job.captures import GRID_KEYS, Board
from tests.workers.capture.drawn import PINHOLE
from workers.capture.board import (
    board_geometry,
    frame_in_board,
    lay_out_print,
    marker_cells,
    marker_corners,
    open_dictionary,
)
from workers.capture.board_kinds import KINDS, BoardSizes, read_board_file
from workers.capture.detect import detect_markers
from workers.capture.sheets import A4_M, EDGE_M, OVERLAP_M, board_pdf, board_png, tile_sheet, tiled_pdf
from workers.capture.simulate.studio import THICKNESS_M, board_body
from workers.geometry.colour import encode_srgb
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


def test_opencvs_charuco_boards_lie_on_ours_in_both_patterns():
    """Markers, ids and the chessboard's corners are OpenCV's, whose frame has its origin at the top left and y down."""
    for (columns, rows), old in itertools.product([(7, 5), (8, 6), (5, 8)], [False, True]):
        board = KINDS["charuco_old" if old else "charuco"](BoardSizes(columns, rows, 0.03, 0.04, "DICT_5X5_100"))
        theirs = cv2.aruco.CharucoBoard((columns, rows), 0.04, 0.03, open_dictionary(board))
        theirs.setLegacyPattern(old)
        geometry, T = board_geometry(board), frame_in_board(board, "opencv")
        assert geometry.ids.tolist() == theirs.getIds().ravel().tolist()
        ours = transform(T, np.array(theirs.getObjPoints(), np.float64).reshape(-1, 3))
        assert geometry.corners.reshape(-1, 3) == pytest.approx(ours, abs=1e-7)
        chess = transform(T, np.array(theirs.getChessboardCorners(), np.float64))
        apart = np.linalg.norm(geometry.chess[:, None] - chess, axis=2)
        assert len(chess) == len(geometry.chess) == (columns - 1) * (rows - 1) and apart.min(axis=1).max() < 2e-7
        assert np.abs(geometry.chess_free_m - 0.005).max() < 1e-6  # the white about a marker
        assert read_again(board) == board


def read_again(board):
    return Board.model_validate_json(board.model_dump_json())


def test_a_grid_written_marker_by_marker_is_the_same_board():
    """One mechanism: neighbours, corners and frames of a list are those of the grid; and a grid is written as it always was."""
    grid = Board(columns=4, rows=3, first_id=5, measured_ruler_m=0.21)
    places = marker_corners(grid.model_copy(update={"measured_ruler_m": None})).tolist()
    markers = [{"id": 5 + n, "corners": quad} for n, quad in enumerate(places)]
    listed = Board.model_validate({"markers": markers[::-1], "measured_ruler_m": 0.21})
    one, other = board_geometry(grid), board_geometry(listed)
    for name in ("ids", "corners", "right", "below"):
        assert getattr(one, name) == pytest.approx(getattr(other, name)), name
    assert one.right.reshape(3, 4).tolist() == [[1, 2, 3, -1], [5, 6, 7, -1], [9, 10, 11, -1]]
    assert one.below.reshape(3, 4).tolist() == [[4, 5, 6, 7], [8, 9, 10, 11], [-1] * 4]
    for frame in ("centre", "opencv", "opencv_old"):
        assert frame_in_board(grid, frame) == pytest.approx(frame_in_board(listed, frame))
    beside = np.array([[-0.05, 0.05, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.0], [-0.05, 0.0, 0.0]])
    for moved, met in (([0.07, 0, 0], 1), ([0.07, 0.01, 0], -1), ([0.07, 0, 0.01], -1), ([0.12, 0, 0], -1)):
        two = [{"id": n, "corners": (beside + n * np.array(moved)).tolist()} for n in (0, 1)]
        assert board_geometry(Board.model_validate({"markers": two})).right.tolist() == [met, -1]
    assert read_again(listed) == listed and set(GRID_KEYS) < listed.unwritten
    first_keys = "dictionary columns rows marker_m gap_m width_m height_m first_id ruler_m measured_ruler_m"
    assert list(grid.model_dump(exclude=grid.unwritten)) == first_keys.split()
    stands = [{"id": 0, "corners": [[0, 0, 0.1], [0.1, 0, 0.1], [0.1, 0, 0], [0, 0, 0]]}]
    with pytest.raises(CaptureError, match="frame opencv is of a flat board"):
        frame_in_board(Board.model_validate({"markers": stands}), "opencv")
    with pytest.raises(InputError, match="turned, or not in the plane"):
        lay_out_print(Board.model_validate({"markers": stands}))
    with pytest.raises(InputError, match="without --tiles"):
        tiled_pdf(listed)


CODES = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98)
"""The first four of the family tag36h11, as the AprilTag library publishes them: 36 bits, row by row, 1 for white."""
TAG_PX, GAP_PX = 200, 60


def kalibrs_picture():
    """2 x 2 tags drawn by Kalibr's rules: upright, border of two bits, id 0 at the lower left, squares at all corners."""
    picture = np.full((2 * TAG_PX + 5 * GAP_PX,) * 2, 255, np.uint8)
    for number, code in enumerate(CODES):
        bits = np.pad([[int(b) for b in format(code, "036b")[6 * r : 6 * r + 6]] for r in range(6)], 2)
        x, y = 2 * GAP_PX + (number % 2) * (TAG_PX + GAP_PX), 2 * GAP_PX + (1 - number // 2) * (TAG_PX + GAP_PX)
        picture[y : y + TAG_PX, x : x + TAG_PX] = np.kron(255 * bits, np.ones((20, 20)))
        for u, v in itertools.product((x - GAP_PX, x + TAG_PX), (y - GAP_PX, y + TAG_PX)):
            picture[v : v + GAP_PX, u : u + GAP_PX] = 0
    return picture


def test_kalibrs_grid_is_found_where_its_target_file_has_it(tmp_path):
    (tmp_path / "target.yaml").write_text(
        "target_type: 'aprilgrid' #gridtype\ntagCols: 2\ntagRows: 2\ntagSize: 0.1\ntagSpacing: 0.3  # ratio\n"
    )
    board = read_board_file(tmp_path / "target.yaml")
    geometry, picture = board_geometry(board), kalibrs_picture()
    assert not len(geometry.chess) and len(geometry.squares) == 9
    # Kalibr's frame: origin at the lower left corner of tag 0, y up, z out of the board; pixels from the image's edge.
    from_kalibr = np.array([[2000.0, 0, 120], [0, -2000, 120 + 460]])
    T_kalibr_board = np.linalg.inv(frame_in_board(board, "opencv_old"))
    for blur_px in (0.5, 1.5):
        light = cv2.GaussianBlur(0.02 + 0.8 * (picture / 255.0), (0, 0), blur_px)
        blurred = np.rint(255 * encode_srgb(light)).astype(np.uint8)
        found = detect_markers(np.repeat(blurred[..., None], 3, 2), board, open_dictionary(board), PINHOLE)
        assert found.ids.tolist() == [0, 1, 2, 3] and not found.dropped
        points = transform(T_kalibr_board, geometry.corners.reshape(-1, 3))
        expected = points[:, :2] @ from_kalibr[:, :2].T + from_kalibr[:, 2]
        assert np.abs(found.corners_px.reshape(-1, 2) - expected).max() < 0.05
    ours = Image.open(io.BytesIO(board_png(board, 254.0)))  # and our print is Kalibr's
    bits = np.asarray(ours.resize((ours.width // 50, ours.height // 50), Image.Resampling.BOX)) < 128
    theirs = picture[GAP_PX:-GAP_PX, GAP_PX:-GAP_PX][5::10, 5::10] < 128
    top, left = (n // 2 - m // 2 for n, m in zip(bits.shape, theirs.shape, strict=True))
    assert (bits[top : top + len(theirs), left : left + len(theirs)] == theirs).mean() > 0.99


@pytest.mark.minute
def test_boards_of_other_programs_are_read_from_their_own_files(tmp_path):
    """A bundle's tags have their frame x to the right of the upright tag, y up, z out; the others list corners or sizes."""

    def read(name, text):
        (tmp_path / name).write_text(text)
        return read_board_file(tmp_path / name)

    turned = "qw: 0.5, qx: 0.5, qy: 0.5, qz: 0.5"  # takes x to y, y to z and z to x, where its print faces
    bundle = f"""tag_family: tag36h11
tag_border: 1
standalone_tags: []
tag_bundles:
  [{{name: 'b', layout: [{{id: 2, size: 0.04, x: 0.1, y: 0.2, z: 0.05, {turned}}}, {{id: 0, size: 0.06, x: 0, y: 0, z: 0}}]}}]
"""
    board = read("tags.yaml", bundle)
    geometry = board_geometry(board)
    assert board.dictionary == "DICT_APRILTAG_36h11" and geometry.ids.tolist() == [0, 2] and board.border_bits == 1
    # The upright tag's corners from the upper left, clockwise; OpenCV's picture begins at the opposite one.
    upright = np.array([[-0.03, 0.03, 0], [0.03, 0.03, 0], [0.03, -0.03, 0], [-0.03, -0.03, 0]])
    assert geometry.corners[0] == pytest.approx(upright[[2, 3, 0, 1]])
    stands = np.array([[0.1, 0.18, 0.07], [0.1, 0.22, 0.07], [0.1, 0.22, 0.03], [0.1, 0.18, 0.03]])
    assert geometry.corners[1] == pytest.approx(stands[[2, 3, 0, 1]], abs=1e-7)
    corners = ", ".join(f"[ {x}, {y}, 0. ]" for x, y in upright[:, :2])  # as OpenCV writes it
    marker_map = "%YAML:1.0\n---\naruco_bc_dict: ARUCO_MIP_36h12\naruco_bc_mInfoType: 1\naruco_bc_markers:\n"
    mapped = read("map.yml", f"{marker_map}   - {{ id:17, corners:[ {corners} ] }}\n")
    assert mapped.markers[0].id == 17 and np.array(mapped.markers[0].corners) == pytest.approx(upright)
    keys = {"BoardSize_Width": 7, "BoardSize_Height": 5, "Square_Size": 40, "Marker_Size": 30}
    words = "".join(f"<{name}>{value}</{name}>" for name, value in keys.items())
    words += '<Calibrate_Pattern>"CHARUCOBOARD"</Calibrate_Pattern><ArUco_Dict_Name>DICT_5X5_100</ArUco_Dict_Name>'
    xml = f'<?xml version="1.0"?><opencv_storage><Settings>{words}</Settings></opencv_storage>'
    assert read("vid.xml", xml) == KINDS["charuco"](BoardSizes(8, 6, 0.03, 0.04, "DICT_5X5_100"))
    for text, told in (
        ("target_type: 'checkerboard'", "whose corners have no ids: aprilgrid is read"),
        ("target_type: aprilgrid\ntagCols: 2", "has no 'tagSize'"),
        ("target_type: aprilgrid\ntagCols: 2\ntagRows: 2\ntagSize: .nan\ntagSpacing: 0.3", "cannot be"),
        (
            "target_type: aprilgrid\ntagCols: 2\ntagRows: 2\ntagSize: 0.1\ntagSpacing: 0.3\ntagFamily: t25h7",
            "no dictionary",
        ),
        (bundle.replace("qw: 0.5", "qw: 0.9"), "quaternion of tag 2 has not length 1"),
        ("standalone_tags: [{id: 1, size: 0.1}, {id: 2, size: 0.1}]", "2 tags that stand alone"),
        ("aruco_bc_mInfoType: 0\naruco_bc_markers: []", "its lengths are pixels"),
        (xml.replace("CHARUCOBOARD", "CHESSBOARD"), "CHARUCOBOARD is read"),
        (xml.replace(">40<", ">0.04<"), "in millimetres"),
        (xml.replace(">30<", ">50<"), "make the squares larger than the markers"),
        ("target_type: &a [1, 2]\nb: *a", "describes no board"),
        ("\0\1\2", "describes no board"),
        ("[" * 5000, "describes no board"),
    ):
        with pytest.raises(InputError, match=told):
            read("x.yaml", text)


def test_dictionary_that_does_not_exist_or_is_too_small_is_refused():
    with pytest.raises(CaptureError, match="neither one of OpenCV's"):
        open_dictionary(Board(dictionary="DICT_9X9"))
    with pytest.raises(CaptureError, match="has 50 markers, and the board needs 70"):
        open_dictionary(Board(columns=10, rows=7, width_m=1.0, height_m=1.0))


# ---------------------------------------------------------------------------------------------- the sheet


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
    measured = lay_out_print(BOARD.model_copy(update={"measured_ruler_m": 0.19}))  # a print is made at nominal size
    assert np.array_equal(measured.markers, layout.markers)


def test_a_sheet_is_wide_enough_for_its_ruler_or_refused():
    assert lay_out_print(Board(columns=2, rows=3, width_m=0.14, height_m=0.3)).width_m == pytest.approx(0.18)
    with pytest.raises(InputError, match="ruler_m"):
        lay_out_print(Board(rows=2, height_m=0.15))
    with pytest.raises(InputError, match="too many pixels"):
        board_png(BOARD, 10_000.0)


CHARUCO = KINDS["charuco"](BoardSizes(6, 5, 0.03, 0.04, "DICT_5X5_100"))


@pytest.mark.parametrize(("board", "dpi"), [(BOARD, 40.0), (SMALL, 101.6), (CHARUCO, 101.6)])
def test_every_marker_of_the_png_is_found_where_the_layout_has_it(board, dpi):
    image = Image.open(io.BytesIO(board_png(board, dpi)))
    assert image.info["dpi"][0] == pytest.approx(dpi, abs=0.02)
    px_per_m, layout = round(image.info["dpi"][0] / 0.0254), lay_out_print(board)
    assert image.size == (np.ceil(layout.width_m * px_per_m - 1e-6), np.ceil(layout.height_m * px_per_m - 1e-6))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(open_dictionary(board), parameters).detectMarkers(np.asarray(image))
    assert sorted(ids.ravel()) == board_geometry(board).ids.tolist()
    for found, number in zip(corners, ids.ravel(), strict=True):
        true = marker_corners(board)[board_geometry(board).index(int(number)), :, :2]
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
    true = np.concatenate([layout.markers, layout.seams, layout.ruler]) + np.array([0.3, 0.2, 0.3, 0.2])
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
            crossed = np.concatenate([layout.markers, layout.seams, layout.ruler])
            assert not ((crossed[:, 1] < y - 1e-6) & (y + 1e-6 < crossed[:, 3])).any()


def test_the_pages_put_together_give_the_board():
    """Each page's print, cut at its marks and moved to its tile, is the same sheet."""
    data, layout = tiled_pdf(BOARD), lay_out_print(BOARD)
    page, tiles = tile_sheet(BOARD, layout)
    assert len(pages(data)) == len(tiles) == len(boxes(data)) == 8
    true = np.concatenate([layout.markers, layout.seams, layout.ruler])
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
