"""The marker board as pixels: its markers alone, and the whole sheet as a PNG that knows its resolution."""

import io
import math

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from schemas.base import Array
from schemas.errors import InputError
from schemas.job.captures import Board
from workers.capture.board.print_layout import PrintLayout, Words, lay_out_print, marker_cells, nominal

MOST_PIXELS = 400_000_000
"""Of a picture: more would not fit into the memory of a small machine."""


def draw_board(board: Board, px_per_m: float) -> NDArray[np.uint8]:
    """[H, W] uint8: the markers at nominal size on a white board of width_m x height_m, top of the print first.

    The board's upper left corner is the image's; a pixel is as dark as the share of it that is black.
    """
    return _pixels(_light_of_markers(board, (board.width_m, board.height_m), px_per_m))


def board_png(board: Board, dpi: float) -> bytes:
    """PNG bytes of the printed sheet; the file says how many pixels a metre has, rounded to a whole number.

    Raises InputError for a picture that would be too large.
    """
    px_per_m = round(dpi / 0.0254)
    layout = lay_out_print(board)
    if layout.width_m * layout.height_m * px_per_m**2 > MOST_PIXELS:
        raise InputError(f"a board of {layout.width_m:g} x {layout.height_m:g} m at {dpi:g} dpi has too many pixels")
    stream = io.BytesIO()
    picture = draw_print(board, layout, px_per_m)
    Image.fromarray(picture).save(stream, "PNG", dpi=(px_per_m * 0.0254,) * 2)
    return stream.getvalue()


def draw_print(board: Board, layout: PrintLayout, px_per_m: float) -> NDArray[np.uint8]:
    """[H, W] uint8: the printed sheet with its markers, ruler, arrow and text, upper left corner first."""
    light = _light_of_markers(board, (layout.width_m, layout.height_m), px_per_m)
    corner = np.array([-0.5 * layout.width_m, 0.5 * layout.height_m])
    for left, bottom, right, top in layout.ruler:
        across, column = _cover(np.array([left - corner[0], right - corner[0]]) * px_per_m, light.shape[1])
        down, row = _cover(np.array([corner[1] - top, corner[1] - bottom]) * px_per_m, light.shape[0])
        part = light[row : row + len(down), column : column + len(across)]
        np.minimum(part, 1.0 - down @ across.T, out=part)
    picture = _pixels(light)
    arrow = (layout.arrow - corner) * [px_per_m, -px_per_m] - 0.5  # OpenCV has pixel centres at whole numbers
    cv2.fillConvexPoly(picture, np.rint(arrow * 256).astype(np.int32), 0, cv2.LINE_AA, 8)
    for words in layout.words:
        _write(picture, words, ((words.x_m - corner[0]) * px_per_m, (corner[1] - words.y_m) * px_per_m), px_per_m)
    return picture


def _light_of_markers(board: Board, size_m: tuple[float, float], px_per_m: float) -> Array:
    """[H, W] float64: the white share of each pixel of a sheet of a size, with the markers in its middle."""
    width, height = (math.ceil(size * px_per_m - 1e-6) for size in size_m)
    light: Array = np.ones((height, width))
    for cells, corners in zip(marker_cells(board), nominal(board), strict=True):
        edges = np.linspace(0.0, board.marker_m, len(cells) + 1)
        across, column = _cover((corners[0, 0] + 0.5 * size_m[0] + edges) * px_per_m, width)
        down, row = _cover((0.5 * size_m[1] - corners[0, 1] + edges) * px_per_m, height)
        light[row : row + len(down), column : column + len(across)] -= down @ cells.astype(np.float64) @ across.T
    return light


def _pixels(light: Array) -> NDArray[np.uint8]:
    return np.rint(255.0 * np.clip(light, 0.0, 1.0)).astype(np.uint8)


def _cover(edges: Array, count: int) -> tuple[Array, int]:
    """([P, n], first pixel): the share of each of P pixels that lies between two of n + 1 rising edges, pixels."""
    first, last = max(math.floor(edges[0]), 0), min(math.ceil(edges[-1]), count)
    pixel = np.arange(first, last, dtype=np.float64)[:, None]
    cover = np.minimum(pixel + 1.0, edges[None, 1:]) - np.maximum(pixel, edges[None, :-1])
    return np.maximum(cover, 0.0), first


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
