"""Pure: random draws of colours, of materials, and of small textures: labels, wood, stone, cardboard, glazes.

Colours are sRGB in [0, 1]; textures are [h, w, 3] uint8 sRGB, row 0 at the top.
"""

import colorsys
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.scene.shape import Material
from workers.geometry.jit import compiled, compiled_for

Choice = TypeVar("Choice")
Color = tuple[float, float, float]
"""sRGB, each in [0, 1]."""

WHITE: Color = (0.93, 0.92, 0.89)
BLACK: Color = (0.07, 0.07, 0.075)
_GLASSES: tuple[Color, ...] = (
    (0.09, 0.2, 0.09),
    (0.13, 0.26, 0.12),
    (0.3, 0.16, 0.05),
    (0.2, 0.1, 0.04),
    (0.62, 0.74, 0.7),
    (0.7, 0.8, 0.82),
    (0.1, 0.17, 0.36),
)
_GLAZES: tuple[Color, ...] = (
    (0.94, 0.93, 0.9),
    (0.9, 0.86, 0.77),
    (0.15, 0.2, 0.32),
    (0.2, 0.32, 0.27),
    (0.62, 0.33, 0.22),
    (0.76, 0.6, 0.25),
    (0.36, 0.5, 0.56),
    (0.55, 0.57, 0.55),
    (0.82, 0.66, 0.64),
    (0.1, 0.1, 0.11),
    (0.66, 0.73, 0.66),
    (0.55, 0.16, 0.15),
)
_WOODS: tuple[tuple[Color, Color], ...] = (
    ((0.76, 0.6, 0.42), (0.62, 0.45, 0.28)),
    ((0.55, 0.38, 0.24), (0.4, 0.26, 0.15)),
    ((0.36, 0.23, 0.15), (0.24, 0.14, 0.09)),
    ((0.84, 0.73, 0.57), (0.73, 0.6, 0.43)),
    ((0.66, 0.44, 0.28), (0.5, 0.3, 0.17)),
    ((0.5, 0.46, 0.41), (0.38, 0.34, 0.3)),
)


def pick(rng: np.random.Generator, choices: Sequence[Choice]) -> Choice:
    """One of the choices, each as likely as the next."""
    return choices[int(rng.integers(len(choices)))]


def chance(rng: np.random.Generator, share: float) -> bool:
    """True with this probability."""
    return bool(rng.random() < share)


def hsv(h: float, s: float, v: float) -> Color:
    """sRGB of a hue (in turns), saturation and value."""
    return colorsys.hsv_to_rgb(h % 1.0, min(max(s, 0.0), 1.0), min(max(v, 0.0), 1.0))


def vivid(rng: np.random.Generator) -> Color:
    """A printed or moulded colour."""
    return hsv(rng.random(), rng.uniform(0.45, 0.9), rng.uniform(0.4, 0.85))


def pale(rng: np.random.Generator) -> Color:
    """A light, faint colour."""
    return hsv(rng.random(), rng.uniform(0.04, 0.25), rng.uniform(0.82, 0.95))


def jitter(rng: np.random.Generator, color: Color, by: float = 0.04) -> Color:
    """The colour, each channel and the lightness varied by up to `by`."""
    shift = rng.uniform(-by, by, 4)
    r, g, b = (float(min(max(c + shift[3] + 0.5 * d, 0.02), 0.98)) for c, d in zip(color, shift[:3], strict=True))
    return (r, g, b)


def mix(a: Color, b: Color, share: float) -> Color:
    """Colour a blended with `share` of b."""
    r, g, bl = (x + share * (y - x) for x, y in zip(a, b, strict=True))
    return (r, g, bl)


def lightness(color: Color) -> float:
    """Rec. 709 luma of an sRGB colour."""
    return 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2]


def ink_on(rng: np.random.Generator, paper: Color) -> Color:
    """A colour that can be read on the paper."""
    dark = lightness(paper) > 0.45
    if chance(rng, 0.4):
        return BLACK if dark else WHITE
    return hsv(rng.random(), rng.uniform(0.4, 0.95), rng.uniform(0.15, 0.4) if dark else rng.uniform(0.85, 1.0))


def glaze_color(rng: np.random.Generator) -> Color:
    """A colour of glazed pottery."""
    return jitter(rng, pick(rng, _GLAZES), 0.05) if chance(rng, 0.8) else vivid(rng)


def glass_color(rng: np.random.Generator) -> Color:
    """A colour of bottle glass as an opaque body."""
    return jitter(rng, pick(rng, _GLASSES), 0.03)


def wood_colors(rng: np.random.Generator) -> tuple[Color, Color]:
    """The light and the dark colour of a wood."""
    light, dark = pick(rng, _WOODS)
    shift = rng.uniform(-0.05, 0.05)
    towards = WHITE if shift > 0 else BLACK
    return mix(light, towards, abs(shift)), mix(dark, towards, abs(shift))


_STEELS: tuple[Color, ...] = ((0.78, 0.79, 0.8), (0.7, 0.7, 0.71), (0.86, 0.86, 0.85))
_BRASSES: tuple[Color, ...] = ((0.83, 0.69, 0.4), (0.8, 0.56, 0.42))


def solid_color(color: Color, roughness: float, metallic: float = 0.0) -> Material:
    """A material of one colour."""
    return Material((color[0], color[1], color[2], 1.0), metallic=metallic, roughness=float(roughness))


def clear_glass(color: Color, roughness: float) -> Material:
    """Glass or clear plastic, which most renderers draw as an opaque body of this colour."""
    return replace(solid_color(color, roughness), transmission=1.0)


def textured(texture: NDArray[np.uint8], roughness: float, metallic: float = 0.0) -> Material:
    """A material with a texture [h, w, 3] uint8, which becomes read-only."""
    texture.setflags(write=False)
    return Material((1.0, 1.0, 1.0, 1.0), metallic=metallic, roughness=float(roughness), texture=texture)


def plastic(rng: np.random.Generator) -> Material:
    """Moulded plastic of any colour."""
    color = pick(rng, (WHITE, BLACK, vivid(rng), vivid(rng), pale(rng)))
    return solid_color(jitter(rng, color, 0.03), rng.uniform(0.3, 0.6))


def steel(rng: np.random.Generator) -> Material:
    """Bare steel or aluminium."""
    return solid_color(jitter(rng, pick(rng, _STEELS), 0.02), rng.uniform(0.28, 0.5), metallic=1.0)


def metal(rng: np.random.Generator) -> Material:
    """Steel, brass or copper, or painted metal."""
    kind = rng.random()
    if kind < 0.45:
        return steel(rng)
    if kind < 0.6:
        return solid_color(jitter(rng, pick(rng, _BRASSES), 0.03), rng.uniform(0.25, 0.4), metallic=1.0)
    return solid_color(jitter(rng, pick(rng, (BLACK, WHITE, (0.2, 0.21, 0.22))), 0.03), rng.uniform(0.35, 0.6))


Texture = NDArray[np.uint8]
Plane = NDArray[np.float32]


def rgb(color: Color) -> NDArray[np.uint8]:
    """A colour as [3] uint8."""
    return np.array([round(255.0 * c) for c in color], dtype=np.uint8)


def blank(height: int, width: int, color: Color) -> Texture:
    """A texture of one colour."""
    picture = np.empty((height, 3 * width), dtype=np.uint8)
    picture[:] = np.tile(rgb(color), width)  # row by row, because numpy is slow to repeat three bytes
    return picture.reshape(height, width, 3)


def noise(rng: np.random.Generator, height: int, width: int, rows: int, columns: int) -> Plane:
    """[height, width] float32 in [0, 1]: value noise on a lattice of rows x columns; repeats in both directions."""
    return stretched(rng.random((columns, rows), dtype=np.float32), height, width, False)


@compiled_for("f4[:,::1], i8, i8, b1")
def stretched(lattice: Plane, height: int, width: int, smooth: bool) -> Plane:
    """A lattice [columns, rows] interpolated to [height, width], along both the last towards the first.

    Linearly or, where `smooth`, by smoothstep, whose slope is 0 at the points of the lattice.
    """
    columns, rows = lattice.shape
    wide, plane = np.empty((rows, width), np.float32), np.empty((height, width), np.float32)
    turned, before, after, shares = lattice.T.copy(), *_cells(columns, width, smooth)
    for row in range(rows):
        for x in range(width):
            low = turned[row, before[x]]
            wide[row, x] = (turned[row, after[x]] - low) * shares[x] + low
    before, after, shares = _cells(rows, height, smooth)
    for y in range(height):
        below, above, share = wide[before[y]], wide[after[y]], shares[y]
        for x in range(width):
            plane[y, x] = (above[x] - below[x]) * share + below[x]
    return plane


@compiled
def _cells(count: int, size: int, smooth: bool) -> tuple[NDArray[np.int64], NDArray[np.int64], Plane]:
    """For each of `size` pixels, the points of a lattice before and after it, and its share of the way between them."""
    before, after, shares = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.float32)
    for x in range(size):
        at = np.float32(x) * np.float32(count / size)
        low = int(at)
        share = at - np.float32(low)
        if smooth:
            share = share * share * (np.float32(3.0) - np.float32(2.0) * share)
        before[x], after[x], shares[x] = low, (low + 1) % count, share
    return before, after, shares


def blend(a: Color, b: Color, share: Plane) -> Texture:
    """Colour a where `share` [h, w] is 0, colour b where it is 1, in 64 steps."""
    t = (np.arange(64) / 63.0)[:, None]
    steps = np.round(255.0 * (np.array(a) * (1 - t) + np.array(b) * t)).astype(np.uint8)
    return _graded(share, steps)


@compiled_for("f4[:,::1], u1[:,::1]")
def _graded(share: Plane, steps: Texture) -> Texture:
    """The colour of `steps` [64, 3] for each share [h, w] from 0 to 1, rounded to the nearest."""
    height, width = share.shape
    picture = np.empty((height, width, 3), np.uint8)
    for row in range(height):
        for column in range(width):
            level = share[row, column] * np.float32(63.0) + np.float32(0.5)
            color = steps[int(min(max(level, np.float32(0.0)), np.float32(63.0)))]
            for channel in range(3):
                picture[row, column, channel] = color[channel]
    return picture


def wood(rng: np.random.Generator, light: Color, dark: Color, planks: int = 0, size: int = 256) -> Texture:
    """[size, size / 2, 3]: grain along u; with `planks`, boards of slightly different tone with dark seams between them."""
    width = size // 2
    share = 0.6 * noise(rng, size, width, size // 3, 4) + 0.4 * noise(rng, size, width, 10, 2) - np.float32(0.08)
    if planks:
        board = np.arange(size) * planks // size
        share += (0.35 * rng.random(planks, dtype=np.float32) - np.float32(0.17))[board][:, None]
        seam = np.zeros(size, dtype=np.bool_)
        seam[np.flatnonzero(np.diff(board)) + 1] = True
        share[seam] = 1.25
    return blend(light, dark, share)


def kraft(rng: np.random.Generator, color: Color) -> Texture:
    """[128, 128, 3]: kraft cardboard with faint corrugation and fibres."""
    share = 0.5 * noise(rng, 128, 128, 3, 64) + 0.5 * noise(rng, 128, 128, 48, 48)
    return blend(mix(color, WHITE, 0.08), mix(color, BLACK, 0.12), share)


def stone(rng: np.random.Generator, a: Color, b: Color, size: int = 192) -> Texture:
    """Cloudy stone with veins."""
    cloud = 0.6 * noise(rng, size, size, 6, 6) + 0.4 * noise(rng, size, size, 20, 20)
    vein = np.abs(0.65 * noise(rng, size, size, 5, 4) + 0.35 * noise(rng, size, size, 17, 15) - np.float32(0.5))
    share = np.float32(0.55) * cloud + np.clip(np.float32(0.5) - np.float32(14.0) * vein, 0, 1)
    return blend(a, b, share.astype(np.float32))


def band_height(low: float, high: float, radius: float, width: int = 256) -> int:
    """Rows, 16 to 192, that make the pixels of a texture square on a cylinder that it surrounds with `width` columns."""
    return min(max(round(width * (high - low) / (2.0 * math.pi * radius)), 16), 192)


def speckled(
    rng: np.random.Generator, ground: Color, spot: Color, share: float, height: int = 128, width: int = 256
) -> Texture:
    """A ground with small spots on a share of its pixels."""
    picture = blank(height, width, ground)
    picture[rng.random((height, width), dtype=np.float32) < share] = rgb(spot)
    return picture


def flecked(rng: np.random.Generator, glaze: Color, height: int) -> Texture:
    """A glaze with dark flecks."""
    return speckled(rng, glaze, mix(glaze, BLACK, 0.6), rng.uniform(0.02, 0.07), height)


def bands(rng: np.random.Generator, colors: Sequence[Color], height: int = 128) -> Texture:
    """Horizontal stripes of random widths; the first colour covers the most."""
    picture = blank(height, 8, colors[0])
    at = 0
    for color in [*colors[1:], *colors[1:]]:
        at += int(rng.integers(height // 12, height // 3))
        picture[at : at + int(rng.integers(2, height // 6))] = rgb(color)
    return picture


def upright_stripes(rng: np.random.Generator, colors: Sequence[Color], width: int = 256) -> Texture:
    """Vertical stripes that close around a vessel."""
    period = width // int(rng.integers(6, 17))
    stripe = (np.arange(width) % period) * len(colors) // period
    return np.broadcast_to(np.stack([rgb(c) for c in colors])[stripe], (8, width, 3)).copy()


def dots(rng: np.random.Generator, ground: Color, spot: Color, height: int = 128, width: int = 256) -> Texture:
    """A regular pattern of round spots, shifted in every other row."""
    pitch = width // int(rng.integers(8, 17))
    y, x = np.arange(height)[:, None], np.arange(width)[None]
    shift = np.where((y // pitch) % 2 == 1, pitch // 2, 0)
    dx, dy = (x + shift) % pitch - pitch / 2, y % pitch - pitch / 2
    picture = blank(height, width, ground)
    picture[dx * dx + dy * dy < (pitch * rng.uniform(0.18, 0.36)) ** 2] = rgb(spot)
    return picture


def draw_word(
    rng: np.random.Generator, picture: Texture, top: int, left: int, letters: int, size: int, ink: Color
) -> None:
    """Draws letter-like signs of 3 x 5 squares into a texture, clipped at its border."""
    signs = rng.random((letters, 5, 2)) < 0.62
    signs[:, 0, 0] = signs[:, 4, 1] = True
    full = np.concatenate([signs, signs[:, ::-1, :1], np.zeros((letters, 5, 1), dtype=np.bool_)], axis=2)
    word = full.transpose(1, 0, 2).reshape(5, -1).repeat(size, axis=0).repeat(size, axis=1)
    area = picture[max(top, 0) : top + len(word), max(left, 0) : left + word.shape[1]]
    area[word[: area.shape[0], : area.shape[1]]] = rgb(ink)


def draw_small_print(rng: np.random.Generator, picture: Texture, box: tuple[int, int, int, int], ink: Color) -> None:
    """Draws lines of small print into the box (top, left, bottom, right)."""
    top, left, bottom, right = box
    for y in range(top, bottom - 1, 4):
        ends = left + (right - left) * rng.uniform(0.55, 1.0)
        words = rng.random(right - left) < 0.8
        row = picture[y : y + 2, left:right]
        row[:, words & (np.arange(left, right) < ends)] = rgb(ink)


def draw_emblem(
    rng: np.random.Generator, picture: Texture, centre: tuple[float, float], size: float, color: Color
) -> None:
    """Draws a round, square, diamond or ring-shaped emblem about (row, column), `size` its radius in pixels."""
    height, width = picture.shape[:2]
    y, x = (np.arange(height) - centre[0])[:, None] / size, (np.arange(width) - centre[1])[None] / size
    shapes = (
        lambda: x * x + y * y < 1.0,
        lambda: np.maximum(np.abs(x) * 0.7, np.abs(y) * 1.2) < 0.9,
        lambda: np.abs(x) + np.abs(y) < 1.1,
        lambda: np.abs(x * x + y * y - 0.75) < 0.3,
    )
    picture[pick(rng, shapes)()] = rgb(color)


def label(rng: np.random.Generator, paper: Color, height: int = 128, width: int = 256, faces: int = 2) -> Texture:
    """A printed label: emblem, brand and small print, `faces` times around."""
    ink, accent = ink_on(rng, paper), vivid(rng)
    picture = blank(height, width, paper)
    if chance(rng, 0.6):
        edge = int(rng.integers(1, max(height // 8, 2)))
        picture[:edge] = picture[-edge:] = rgb(accent)
    if chance(rng, 0.35):
        split = int(rng.uniform(0.3, 0.7) * height)
        picture[split:] = rgb(mix(paper, accent, 0.8))
    face = width // faces
    letters, size = int(rng.integers(4, 9)), int(rng.integers(3, 6))
    size = max(1, min(size, face // (4 * letters + 2), height // 14))
    top = int(rng.uniform(0.18, 0.5) * height)
    draw_emblem(
        rng, picture[:, :face], (rng.uniform(0.35, 0.65) * height, face / 2), rng.uniform(0.14, 0.3) * height, accent
    )
    draw_word(rng, picture[:, :face], top, (face - 4 * letters * size) // 2, letters, size, ink)
    draw_small_print(rng, picture, (int(0.76 * height), face // 5, int(0.9 * height), face - face // 5), ink)
    for k in range(1, faces):
        picture[:, k * face : (k + 1) * face] = picture[:, :face]
    return picture
