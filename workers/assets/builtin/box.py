"""Pure: boxes with a lid seam: cartons, shoe boxes, gift boxes, printed packets, tins, wooden chests."""

from dataclasses import replace

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Material
from workers.assets.builtin import materials as paint
from workers.assets.builtin.materials import chance, pick
from workers.assets.builtin.parts import Model, Surface, over_top
from workers.assets.builtin.solid import Solid, circle, combine, difference, lathe, union
from workers.assets.builtin.sweeps import bevelled_profile, prism, split_sides, straight_prism

SIDE, LID, TOP, BOTTOM, EXTRA, OTHER = 0, 1, 2, 3, 4, 5

Size = tuple[float, float, float]
"""Width along x, depth along y, height; metres."""


def draw_size(
    rng: np.random.Generator, width: tuple[float, float], depth: tuple[float, float], height: tuple[float, float]
) -> Size:
    """Draws a size: width in metres, depth and height as shares of the width."""
    w = rng.uniform(*width)
    return w, w * rng.uniform(*depth), w * rng.uniform(*height)


def make_box(rng: np.random.Generator) -> Model:
    """A closed box, 60 to 400 mm, of board, tinplate or wood."""
    builders = (_carton, make_lidded, make_lidded, _packet, _packet, _tin, _chest)
    return pick(rng, builders)(rng)


def _front_and_back(material: Material, size: Size) -> tuple[Surface, Surface]:
    """A material mapped once over the front and once over the back, upright seen from outside."""
    w, d, h = size
    front = Surface("front", material, "plane", origin=(-w / 2, -d / 2, 0.0), across=(w, 0.0, 0.0), up=(0.0, 0.0, h))
    return front, replace(front, name="back", origin=(w / 2, d / 2, 0.0), across=(-w, 0.0, 0.0))


def _slotted(size: Size, bevel: float, radius: float, pieces: int, cutter: Solid) -> Solid:
    """A box whose top has a slot; its front is SIDE and its back EXTRA."""
    w, d, h = size
    profile = np.array([[bevel, 0.0], [0.0, bevel], [0.0, 0.5 * h], [0.0, h - bevel], [bevel, h]])
    body = prism(profile, (w, d), radius, [BOTTOM, SIDE, SIDE, SIDE, TOP, TOP], 3, (pieces, pieces))
    return split_sides(difference(body, [cutter]), SIDE, (SIDE, LID, EXTRA, LID))


def _carton(rng: np.random.Generator) -> Model:
    """A cardboard carton: four flaps above, a slot between them, tape along it."""
    size = draw_size(rng, (0.16, 0.4), (0.55, 0.95), (0.4, 0.95))
    w, d, h = size
    board = paint.jitter(rng, (0.72, 0.56, 0.38), 0.05)
    crease = rng.uniform(0.0015, 0.003)
    slot = straight_prism((w + 0.02, 0.003), h - 0.0015, h + 0.01, 0.0008, OTHER)
    paper = paint.textured(paint.kraft(rng, board), 0.85)
    printed = paint.kraft(rng, board)
    if chance(rng, 0.7):
        mark = paint.label(rng, board, height=64, width=128, faces=1)
        inked = np.abs(mark.astype(np.int16) - paint.rgb(board)).sum(axis=2) > 40
        printed[40:104] = np.where(inked[..., None], mark, printed[40:104])
    top = paint.kraft(rng, board)
    if chance(rng, 0.75):
        tape = pick(rng, ((0.8, 0.68, 0.45), (0.85, 0.83, 0.78), paint.vivid(rng)))
        half = max(2, round(0.5 * 128 * rng.uniform(0.05, 0.07) / d))
        top[64 - half : 64 + half] = paint.rgb(paint.mix(board, tape, 0.8))
    front, back = _front_and_back(paint.textured(printed, 0.85), size)
    surfaces = (
        front,
        Surface("sides", paper, "box", size=max(size)),
        over_top("top", paint.textured(top, 0.7), w, d),
        Surface("bottom", paint.solid_color(board, 0.85)),
        back,
        Surface("slot", paint.solid_color(paint.mix(board, paint.BLACK, 0.5), 0.9)),
    )
    return Model(_slotted(size, crease, 0.004, 6, slot), surfaces)


def make_lidded(rng: np.random.Generator) -> Model:
    """A box whose lid is a little wider than it: a shoe box, or a gift box with a ribbon."""
    size = draw_size(rng, (0.08, 0.34), (0.5, 1.0), (0.3, 0.8))
    w, d, h = size
    step, deep = rng.uniform(0.0015, 0.003), h * rng.uniform(0.15, 0.5)
    b = 0.0012
    levels = [0.0, b, 0.5 * (h - deep), h - deep, h - deep, h - b, h]
    profile = np.column_stack([[step + b, step, step, step, 0.0, 0.0, b], levels])
    numbers = [BOTTOM, SIDE, SIDE, SIDE, BOTTOM, LID, LID, TOP]
    body = prism(profile, (w, d), rng.uniform(0.0035, 0.006), numbers, 3, (6, 6))
    color = pick(rng, (paint.vivid(rng), paint.pale(rng), paint.WHITE, paint.BLACK))
    cover = color if chance(rng, 0.4) else paint.jitter(rng, paint.vivid(rng))
    roughness = rng.uniform(0.4, 0.8)
    side = Surface("side", paint.solid_color(color, roughness))
    top = Surface("top", paint.solid_color(cover, roughness))
    ribbon = Surface("ribbon", paint.solid_color(paint.vivid(rng), 0.35))
    if chance(rng, 0.5):
        body = union([body, *_ribbon(rng, size)])
    elif chance(rng, 0.7):
        top = over_top("top", paint.textured(paint.label(rng, cover, height=128, width=128, faces=1), roughness), w, d)
    if chance(rng, 0.4):
        patterns = (
            paint.dots(rng, color, paint.mix(color, paint.ink_on(rng, color), 0.7), 256),
            paint.upright_stripes(rng, [color, paint.mix(color, paint.WHITE, 0.5)]),
        )
        side = Surface("side", paint.textured(pick(rng, patterns), roughness), "box", size=max(size))
    surfaces = (
        side,
        Surface("lid", paint.solid_color(cover, roughness)),
        top,
        Surface("bottom", paint.solid_color(paint.mix(color, paint.BLACK, 0.2), 0.8)),
        ribbon,
    )
    return Model(body, surfaces)


def _ribbon(rng: np.random.Generator, size: Size) -> list[Solid]:
    """Two bands around the box and a bow of two loops and a knot."""
    w, d, h = size
    width, lift = min(w, d) * rng.uniform(0.08, 0.16), 0.0009
    bands_around = [
        straight_prism((w + 2 * lift, width), 0.0, h + lift, 0.0008, EXTRA),
        straight_prism((width, d + 2 * lift), 0.0, h + lift, 0.0008, EXTRA),
    ]
    if chance(rng, 0.3):
        return bands_around
    loop = min(w, d) * rng.uniform(0.13, 0.2)
    bow = []
    for sign in (-1.0, 1.0):
        petal = _ellipsoid(np.array([loop, 0.55 * width, 0.5 * loop]))
        axes = _turned(sign, rng.uniform(0.2, 0.6))
        bow.append(petal.placed(axes, np.array([sign * 1.08 * loop, 0.0, h + 0.3 * loop])))
    knot = _ellipsoid(np.array([0.4 * loop, 0.6 * width, 0.42 * loop])).moved(z=h + 0.25 * loop)
    return [*bands_around, combine(bow), knot]


def _turned(sign: float, slope: float) -> Array:
    """[3, 3]: rotation about y under which x rises with `slope` towards the side `sign`."""
    length = float(np.sqrt(1.0 + slope * slope))
    c, s = 1.0 / length, sign * slope / length
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _ellipsoid(radii: Array) -> Solid:
    """An ellipsoid about the origin."""
    half = circle(16)[4:13]
    profile = np.stack([-half[:, 0], -half[:, 1]], axis=1)
    return lathe(profile, [EXTRA] * (len(profile) - 1), 12).stretched(radii)


def _packet(rng: np.random.Generator) -> Model:
    """A printed packet: cereals, crackers, tea; a closing seam along the top."""
    size = draw_size(rng, (0.06, 0.2), (0.25, 0.6), (0.9, 1.55))
    w, d, h = size
    seam = straight_prism((w + 0.02, 0.0016), h - 0.001, h + 0.01, 0.0004, OTHER)
    body = _slotted(size, 0.0015, 0.0025, 5, seam.moved(y=d * rng.uniform(-0.2, 0.2)))
    paper = paint.vivid(rng) if chance(rng, 0.75) else paint.pale(rng)
    picture = paint.label(rng, paper, height=160, width=128, faces=1)
    gloss = rng.uniform(0.35, 0.7)
    front, back = _front_and_back(paint.textured(picture, gloss), size)
    second = (
        paint.bands(rng, [paper, paint.mix(paper, paint.WHITE, 0.6)])
        if chance(rng, 0.4)
        else paint.blank(8, 8, paint.jitter(rng, paper))
    )
    side = Surface(
        "sides", paint.textured(second, gloss), "plane", origin=(0, -d / 2, 0), across=(0, d, 0), up=(0, 0, h)
    )
    surfaces = (
        front,
        side,
        Surface("top", paint.solid_color(paint.jitter(rng, paper, 0.02), gloss)),
        Surface("bottom", paint.solid_color(paper, 0.7)),
        back,
        Surface("seam", paint.solid_color(paint.mix(paper, paint.BLACK, 0.5), 0.8)),
    )
    return Model(body, surfaces)


def _tin(rng: np.random.Generator) -> Model:
    """A tinplate box with round corners and a pressed lid."""
    w, d, h = draw_size(rng, (0.08, 0.25), (0.5, 1.0), (0.25, 0.9))
    radius = min(w, d) * rng.uniform(0.12, 0.45)
    deep, b, step = min(0.02, 0.25 * h), 0.003, 0.0012
    t = h - 0.0035
    profile = np.column_stack(
        [
            [b, 0.4 * b, step, step, step, 0.0, 0.0, 0.0012, 0.12 * min(w, d), 0.12 * min(w, d) + 0.004],
            [0.0, 0.15 * b, b, 0.5 * h, h - deep, h - deep + 0.0005, t - 0.002, t - 0.0003, t, h],
        ]
    )
    body = prism(profile, (w, d), radius, [BOTTOM, BOTTOM, *[SIDE] * 3, *[LID] * 5, TOP], 6, (2, 2))
    paper = paint.vivid(rng) if chance(rng, 0.7) else paint.pale(rng)
    shine, gloss = (0.5 if chance(rng, 0.4) else 0.0), rng.uniform(0.3, 0.5)
    lid = paint.metal(rng) if chance(rng, 0.3) else paint.solid_color(paint.jitter(rng, paper), gloss, shine)
    picture = paint.label(rng, paper, paint.band_height(0.0, h, 0.5 * (w + d) / 3.14), faces=2)
    surfaces = (
        Surface("side", paint.textured(picture, gloss, shine), "cylinder", low=0.0, high=h - deep),
        Surface("lid", lid),
        Surface("top", lid),
        Surface("bottom", paint.metal(rng)),
    )
    return Model(body, surfaces)


def _chest(rng: np.random.Generator) -> Model:
    """A wooden box: boards with grooves between them, a seam below the lid, perhaps a clasp."""
    size = draw_size(rng, (0.12, 0.35), (0.5, 0.9), (0.4, 0.85))
    w, d, h = size
    lid, groove, boards = h * rng.uniform(0.2, 0.35), 0.0016, int(rng.integers(1, 4))
    b = 0.002
    levels = np.linspace(0.0, h - lid, boards + 1)[1:]
    points = [[b, 0.0], [0.0, b]]
    for z in levels:
        deep = groove if z < levels[-1] else 1.6 * groove
        points += [[0.0, z - deep], [deep, z], [0.0, z + deep]]
    profile = np.array([*points, [0.0, h - b], [b, h]])
    body = prism(profile, (w, d), 0.003, [BOTTOM, *[SIDE] * (len(profile) - 1), TOP], 3, (4, 4))
    if chance(rng, 0.6):
        slab = prism(bevelled_profile(0.5 * lid, 0.001), (0.1 * w, 0.008), 0.0015, [EXTRA] * 5, 2)
        body = union([body, slab.moved(y=-d / 2, z=h - 1.25 * lid)])
    light, dark = paint.wood_colors(rng)
    timber = paint.textured(paint.wood(rng, light, dark, size=128), rng.uniform(0.5, 0.8))
    grain = [Surface(name, timber, "box", size=max(size)) for name in ("side", "lid", "top", "bottom")]
    return Model(body, (*grain, Surface("clasp", paint.metal(rng))))
