"""Pure: open laptops."""

import itertools
import math

import numpy as np

from schemas.base import Array
from workers.assets.builtin import materials as paint
from workers.assets.builtin.materials import Color, Texture, chance, pick
from workers.assets.builtin.parts import Model, Surface
from workers.assets.builtin.solid import TRIG_DIGITS, Solid, combine, difference, lathe, union
from workers.assets.builtin.sweeps import bevelled_profile, prism, straight_prism

CASE, LID, SCREEN, BEZEL, DECK, PAD = 0, 1, 2, 3, 4, 5
DECK_WIDTH, DECK_DEPTH, DECK_MIDDLE = 0.86, 0.44, 0.12
"""The deck of keys: width and depth, and its offset behind the middle, as shares of the laptop's width and depth."""


def make_laptop(rng: np.random.Generator) -> Model:
    """A laptop, 250 to 400 mm wide, its screen 95 to 130 degrees open, with keys and a touch pad."""
    width = rng.uniform(0.25, 0.4)
    depth = width * rng.uniform(0.64, 0.74)
    thick = rng.uniform(0.011, 0.021)
    lid_thick = thick * rng.uniform(0.32, 0.5)
    radius = rng.uniform(0.004, 0.014)
    angle = rng.uniform(math.radians(95.0), math.radians(130.0))
    base = _base(rng, (width, depth), thick, radius)
    lid = _screen(rng, (width, depth), lid_thick, radius)
    # The screen lies closed on the base, turns about the hinge's axis and stands behind the keys.
    hinge = np.array([0.0, 0.5 * depth - 0.5 * thick, thick + 0.15 * lid_thick])
    c, s = round(math.cos(angle), TRIG_DIGITS), round(math.sin(angle), TRIG_DIGITS)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    opened = lid.placed(axes, hinge)
    barrel = _hinge(width * rng.uniform(0.55, 0.8), 0.5 * thick, hinge)
    return Model(union([base, opened, barrel]), _surfaces(rng, (width, depth), hinge, axes))


def _base(rng: np.random.Generator, size: tuple[float, float], thick: float, radius: float) -> Solid:
    """The lower half: a slab with a sunken deck for the keys and a sunken touch pad."""
    width, depth = size
    slab = prism(bevelled_profile(thick, 0.12 * thick), size, radius, [CASE] * 5, 4)
    well = _plate((DECK_WIDTH * width, DECK_DEPTH * depth), thick - 0.0012, thick + 0.01, DECK)
    pad_size = width * rng.uniform(0.28, 0.42), depth * rng.uniform(0.26, 0.32)
    pad = _plate(pad_size, thick - 0.0007, thick + 0.01, PAD).moved(y=-0.5 * depth + 0.05 * depth + 0.5 * pad_size[1])
    return difference(slab, [combine([well.moved(y=DECK_MIDDLE * depth), pad])])


def _plate(size: tuple[float, float], low: float, high: float, surface: int) -> Solid:
    return straight_prism(size, low, high, 0.0015, surface, 2)


def _screen(rng: np.random.Generator, size: tuple[float, float], thick: float, radius: float) -> Solid:
    """The upper half, closed, hinge along the x axis: the sunken screen faces down, the lid up."""
    width, depth = size
    border, sunk, b = rng.uniform(0.006, 0.015), 0.0006, 0.2 * thick
    profile = np.array([[border, sunk], [border, 0.0], [b, 0.0], [0.0, b], [0.0, thick - b], [b, thick]])
    slab = prism(profile, (width, depth), radius, [SCREEN, BEZEL, BEZEL, LID, LID, LID, LID], 4)
    return slab.moved(y=-0.5 * depth + 0.3 * thick)


def _hinge(length: float, radius: float, at: Array) -> Solid:
    """A barrel along x about the hinge's axis."""
    r = 0.8 * radius
    profile = np.array([[0.0, -0.5 * length], [r, -0.5 * length], [r, 0.5 * length], [0.0, 0.5 * length]])
    barrel = lathe(profile, [LID] * 3, 16)
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    return barrel.placed(axes, at)


def _surfaces(rng: np.random.Generator, size: tuple[float, float], hinge: Array, axes: Array) -> tuple[Surface, ...]:
    width, depth = size
    greys = ((0.76, 0.77, 0.78), (0.62, 0.63, 0.65), (0.34, 0.35, 0.37), (0.12, 0.12, 0.13))
    if chance(rng, 0.88):
        color = paint.jitter(rng, pick(rng, (*greys, (0.84, 0.78, 0.72))), 0.03)
    else:
        color = paint.mix(paint.vivid(rng), (0.5, 0.5, 0.5), 0.4)
    metallic = 0.8 if chance(rng, 0.6) else 0.0
    case = paint.solid_color(color, rng.uniform(0.35, 0.55), metallic)
    key = paint.BLACK if chance(rng, 0.7) else paint.mix(color, paint.WHITE, 0.5)
    board = _keyboard(
        rng, paint.jitter(rng, key, 0.02), paint.mix(color, paint.BLACK, 0.4 if key == paint.BLACK else 0.2)
    )
    low, across = (DECK_MIDDLE - 0.5 * DECK_DEPTH) * depth, (DECK_WIDTH * width, 0.0, 0.0)
    origin, up = (-0.5 * across[0], low, 0.0), (0.0, DECK_DEPTH * depth, 0.0)
    keys = Surface("keys", paint.textured(board, 0.6), "plane", origin=origin, across=across, up=up)
    bezel = case if chance(rng, 0.2) else paint.solid_color(paint.jitter(rng, paint.BLACK, 0.02), 0.4)
    # The closed screen's picture: u along x, v from the hinge to the free edge, carried along by the turn.
    corner, across = hinge - 0.5 * width * axes[0], (width, 0.0, 0.0)
    screen = Surface(
        "screen", paint.textured(_desktop(rng), 0.25), "plane", origin=corner, across=across, up=-depth * axes[1]
    )
    return (
        Surface("case", case),
        Surface("lid", case),
        screen,
        Surface("bezel", bezel),
        keys,
        Surface("pad", paint.solid_color(paint.mix(color, paint.BLACK, 0.12), 0.3, 0.5 * metallic)),
    )


def _keyboard(rng: np.random.Generator, key: Color, deck: Color) -> Texture:
    """Rows of keys with a light edge above; the lowest row has the space bar."""
    height, width, rows = 80, 224, 5
    columns = int(rng.integers(12, 15))
    picture = paint.blank(height, width, deck)
    letter = paint.rgb(paint.mix(key, paint.WHITE if paint.lightness(key) < 0.45 else paint.BLACK, 0.6))
    cap, edge = paint.rgb(key), paint.rgb(paint.mix(key, paint.WHITE, 0.25))
    pitch = height // rows
    for row in range(rows):
        top = (rows - 1 - row) * pitch
        stops = [width * k // columns for k in range(columns + 1)]
        if row == 0:  # the space bar takes the place of the middle keys
            stops = [x for k, x in enumerate(stops) if k <= columns // 3 or k >= columns - columns // 3]
        for left, right in itertools.pairwise(stops):
            picture[top + 1 : top + pitch - 1, left + 1 : right - 1] = cap
            picture[top + 1, left + 1 : right - 1] = edge
            if right - left < 2 * width // columns:
                picture[top + 5 : top + 9, left + 6 : left + 9] = letter
    return picture


def _desktop(rng: np.random.Generator) -> Texture:
    """The picture on the screen: nothing, a landscape of colours, or windows of text."""
    height, width = 128, 192
    kind = rng.random()
    if kind < 0.25:
        return paint.blank(8, 8, (0.03, 0.03, 0.035))
    hue = rng.random()
    a = paint.hsv(hue, rng.uniform(0.3, 0.8), rng.uniform(0.2, 0.5))
    b = paint.hsv(hue + rng.uniform(-0.2, 0.2), rng.uniform(0.2, 0.7), rng.uniform(0.6, 0.95))
    slope = np.broadcast_to(np.linspace(1.0, 0.0, height, dtype=np.float32)[:, None], (height, width))
    picture = paint.blend(a, b, 0.5 * slope + 0.5 * paint.noise(rng, height, width, 3, 4))
    picture[-9:] = paint.rgb(paint.mix(a, paint.BLACK, 0.6))
    if kind > 0.6:
        for _ in range(int(rng.integers(1, 4))):
            _window(rng, picture)
    return picture


def _window(rng: np.random.Generator, picture: Texture) -> None:
    height, width = picture.shape[:2]
    top, left = int(rng.integers(4, height // 2)), int(rng.integers(4, width // 2))
    bottom, right = min(top + int(rng.integers(35, 80)), height - 12), min(left + int(rng.integers(50, 110)), width - 4)
    paper = paint.WHITE if chance(rng, 0.6) else (0.13, 0.14, 0.17)
    picture[top:bottom, left:right] = paint.rgb(paper)
    picture[top : top + 6, left:right] = paint.rgb(paint.mix(paper, (0.5, 0.5, 0.55), 0.5))
    paint.draw_small_print(
        rng, picture, (top + 10, left + 5, bottom - 4, right - 5), paint.mix(paper, (0.5, 0.5, 0.5), 0.9)
    )
