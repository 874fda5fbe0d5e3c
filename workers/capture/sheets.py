"""The marker board as a file to print: a PNG that knows its resolution, a PDF of one sheet, or A4 pages to glue."""

import io
import math
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from reportlab.pdfgen.canvas import Canvas

from schemas.base import Array
from schemas.errors import InputError
from schemas.job.captures import Board
from workers.capture.board import PrintLayout, Words, lay_out_print

MOST_PIXELS = 400_000_000
"""Of a picture: more would not fit into the memory of a small machine."""


def board_png(board: Board, dpi: float) -> bytes:
    """PNG bytes of the printed sheet; the file says how many pixels a metre has, rounded to a whole number.

    Raises InputError for a picture that would be too large.
    """
    px_per_m = round(dpi / 0.0254)
    layout = lay_out_print(board)
    if layout.width_m * layout.height_m * px_per_m**2 > MOST_PIXELS:
        raise InputError(f"a board of {layout.width_m:g} x {layout.height_m:g} m at {dpi:g} dpi has too many pixels")
    stream = io.BytesIO()
    picture = draw_print(layout, px_per_m)
    Image.fromarray(picture).save(stream, "PNG", dpi=(px_per_m * 0.0254,) * 2)
    return stream.getvalue()


def draw_print(layout: PrintLayout, px_per_m: float) -> NDArray[np.uint8]:
    """[H, W] uint8: the printed sheet with its markers, ruler, arrow and text, upper left corner first."""
    width, height = (math.ceil(size * px_per_m - 1e-6) for size in (layout.width_m, layout.height_m))
    light, corner = np.ones((height, width)), np.array([-0.5 * layout.width_m, 0.5 * layout.height_m])
    for of_ruler, rectangles in enumerate((layout.markers, layout.ruler)):
        for left, bottom, right, top in rectangles:
            across, column = _cover((left - corner[0]) * px_per_m, (right - corner[0]) * px_per_m, width)
            down, row = _cover((corner[1] - top) * px_per_m, (corner[1] - bottom) * px_per_m, height)
            part = light[row : row + len(down), column : column + len(across)]
            np.minimum(part, (1.0 if of_ruler else part) - np.outer(down, across), out=part)
    picture = np.rint(255.0 * np.clip(light, 0.0, 1.0)).astype(np.uint8)
    arrow = (layout.arrow - corner) * [px_per_m, -px_per_m] - 0.5  # OpenCV has pixel centres at whole numbers
    cv2.fillConvexPoly(picture, np.rint(arrow * 256).astype(np.int32), 0, cv2.LINE_AA, 8)
    for words in layout.words:
        _write(picture, words, ((words.x_m - corner[0]) * px_per_m, (corner[1] - words.y_m) * px_per_m), px_per_m)
    return picture


def _cover(start: float, stop: float, count: int) -> tuple[Array, int]:
    """([P], first pixel): the share of each of P pixels, of a line of `count`, that lies between two places, pixels."""
    first, last = max(math.floor(start), 0), min(math.ceil(stop), count)
    pixel = np.arange(first, last, dtype=np.float64)
    return np.maximum(np.minimum(pixel + 1.0, stop) - np.maximum(pixel, start), 0.0), first


def _write(picture: NDArray[np.uint8], words: Words, at: tuple[float, float], px_per_m: float) -> None:
    """Darkens the picture by a line of text whose baseline starts at column and row `at`."""
    size = words.height_m * px_per_m / 0.72  # the height of a capital over the size of a font
    if size < 4.0:
        return  # not to be read at this resolution
    font = ImageFont.load_default(size)
    line = Image.new("L", (math.ceil(font.getlength(words.words)) + 2, math.ceil(1.5 * size)), 255)
    ImageDraw.Draw(line).text((0, size), words.words, 0, font, anchor="ls")
    pixels = np.rot90(np.asarray(line), words.turn_deg // 90)
    drop = {0: (0.0, -size), -90: (-(line.height - size), 0.0)}[words.turn_deg]
    column, row = round(at[0] + drop[0]), round(at[1] + drop[1])
    part = picture[max(row, 0) : row + pixels.shape[0], max(column, 0) : column + pixels.shape[1]]
    np.minimum(part, pixels[max(-row, 0) :, max(-column, 0) :][: part.shape[0], : part.shape[1]], out=part)


POINTS_PER_M = 72 / 0.0254
A4_M = (0.210, 0.297)

EDGE_M = 0.010
"""Of a page, left free: printers reach to 5 mm of the paper's edge, and the number of the page stands there."""

OVERLAP_M = 0.005
"""By which the print goes on beyond a seam, for paper that is not cut exactly."""


class Tile(NamedTuple):
    """The part of the sheet that one page shows: board frame, metres; column and row from the upper left, from 0."""

    left: float
    bottom: float
    right: float
    top: float
    column: int
    row: int


def board_pdf(board: Board) -> bytes:
    """PDF bytes: one page of the sheet's size. Raises as `lay_out_print` does."""
    layout = lay_out_print(board)
    stream, canvas = _canvas(board, (layout.width_m, layout.height_m))
    canvas.translate(0.5 * layout.width_m * POINTS_PER_M, 0.5 * layout.height_m * POINTS_PER_M)
    _draw(canvas, layout)
    canvas.save()
    return stream.getvalue()


def tiled_pdf(board: Board) -> bytes:
    """PDF bytes: A4 pages of the same sheet, row by row, with lines to cut along and the place of each page.

    Raises InputError for a board that is no grid: seams would cut its markers.
    """
    if board.markers:
        raise InputError(f"a board of {board.words} has no gaps to cut along: print it on one sheet, without --tiles")
    layout = lay_out_print(board)
    page, tiles = tile_sheet(board, layout)
    stream, canvas = _canvas(board, page)
    for number, tile in enumerate(tiles, start=1):
        width, height = tile.right - tile.left, tile.top - tile.bottom
        left, bottom = 0.5 * (page[0] - width), 0.5 * (page[1] - height)  # in the middle of the page
        canvas.saveState()
        canvas.translate((left - tile.left) * POINTS_PER_M, (bottom - tile.bottom) * POINTS_PER_M)
        path = canvas.beginPath()  # what lies beyond the tile and its overlap is left out
        corner, size = (tile.left, tile.bottom), (width, height)
        path.rect(
            *((x - OVERLAP_M) * POINTS_PER_M for x in corner), *((x + 2 * OVERLAP_M) * POINTS_PER_M for x in size)
        )
        canvas.clipPath(path, stroke=0, fill=0)
        _draw(canvas, layout)
        canvas.restoreState()
        _cut_marks(canvas, (left, left + width), (bottom, bottom + height))
        place = f"row {tile.row + 1} of {tiles[-1].row + 1} from the top, column {tile.column + 1} of {tiles[-1].column + 1}"
        words = f"page {number} of {len(tiles)}: {place} from the left; cut along the marks, glue edge to edge"
        canvas.setFont("Helvetica", 6)
        canvas.drawCentredString(0.5 * page[0] * POINTS_PER_M, 0.006 * POINTS_PER_M, words)
        canvas.showPage()
    canvas.save()
    return stream.getvalue()


def tile_sheet(board: Board, layout: PrintLayout) -> tuple[tuple[float, float], list[Tile]]:
    """(page width and height, tiles row by row): the orientation of A4 with fewer pages; seams lie between markers."""
    choices = []
    for page in (A4_M, A4_M[::-1]):
        most = [length - 2 * EDGE_M - 2 * OVERLAP_M for length in page]
        across = _seams(layout.width_m, board.columns, board, most[0])
        up = _seams(layout.height_m, board.rows, board, most[1])
        tiles = [
            Tile(left, -top, right, -bottom, column, row)
            for row, (bottom, top) in enumerate(pairwise(up))
            for column, (left, right) in enumerate(pairwise(across))
        ]
        choices.append((page, tiles))
    return min(choices, key=lambda choice: len(choice[1]))


def _seams(length: float, count: int, board: Board, most: float) -> list[float]:
    """Where the sheet is cut along one axis, ends included: in the middle of a gap, as far on as a page reaches."""
    pitch = board.marker_m + board.gap_m
    gaps = [(i - 0.5 * count) * pitch for i in range(1, count)]
    seams = [-0.5 * length]
    while seams[-1] + most < 0.5 * length - 1e-9:
        reach = seams[-1] + most
        between = [gap for gap in gaps if seams[-1] + 1e-9 < gap <= reach + 1e-9]
        seams.append(between[-1] if between else reach)  # a marker larger than a page has to be cut
    return [*seams, 0.5 * length]


def _canvas(board: Board, page: tuple[float, float]) -> tuple[io.BytesIO, Canvas]:
    """A stream, and a canvas that writes into it: no date and no compression, so that the same board has the same bytes."""
    stream = io.BytesIO()
    canvas = Canvas(stream, [length * POINTS_PER_M for length in page], pageCompression=0, invariant=1)
    canvas.setTitle(f"Marker board {board.dictionary}")
    canvas.setViewerPreference("PrintScaling", "None")
    return stream, canvas


def _draw(canvas: Canvas, layout: PrintLayout) -> None:
    """Draws the sheet with the board frame's origin at the canvas's."""
    canvas.setFillGray(0)
    for left, bottom, right, top in np.concatenate([layout.markers, layout.seams, layout.ruler]) * POINTS_PER_M:
        canvas.rect(left, bottom, right - left, top - bottom, stroke=0, fill=1)
    path = canvas.beginPath()
    path.moveTo(*(layout.arrow[0] * POINTS_PER_M))
    for point in layout.arrow[1:]:
        path.lineTo(*(point * POINTS_PER_M))
    canvas.drawPath(path, stroke=0, fill=1)
    for words in layout.words:
        canvas.saveState()
        canvas.translate(words.x_m * POINTS_PER_M, words.y_m * POINTS_PER_M)
        canvas.rotate(words.turn_deg)
        canvas.setFont("Helvetica", words.height_m * POINTS_PER_M / 0.72)
        canvas.drawString(0, 0, words.words)
        canvas.restoreState()


def _cut_marks(canvas: Canvas, across: tuple[float, float], up: tuple[float, float]) -> None:
    """Thin grey lines outside the corners of a tile between these edges, along which the page is cut."""
    canvas.saveState()
    canvas.setStrokeGray(0.4)
    canvas.setLineWidth(0.2)
    for x, right in zip(across, (-0.8 * EDGE_M, 0.8 * EDGE_M), strict=True):
        for y, upwards in zip(up, (-0.8 * EDGE_M, 0.8 * EDGE_M), strict=True):
            canvas.line(*(p * POINTS_PER_M for p in (x, y, x + right, y)))
            canvas.line(*(p * POINTS_PER_M for p in (x, y, x, y + upwards)))
    canvas.restoreState()
