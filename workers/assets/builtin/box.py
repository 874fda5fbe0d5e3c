"""Pure: boxes with a lid seam: cartons, shoe boxes, gift boxes, printed packets, tins, wooden chests."""

import numpy as np

from workers.assets.builtin.draws import chance, pick
from workers.assets.builtin.gift import BOTTOM, EXTRA, LID, OTHER, SIDE, TOP, draw_size, make_lidded, on_front
from workers.assets.builtin.materials import metal, solid_color, textured
from workers.assets.builtin.palette import BLACK, WHITE, Color, jitter, mix, pale, vivid, wood_colors
from workers.assets.builtin.parts import Model, Surface, over_top
from workers.assets.builtin.solid import difference, union
from workers.assets.builtin.sweeps import bevelled_profile, prism, split_sides, straight_prism
from workers.assets.builtin.textures import Texture, band_height, bands, blank, blend, label, noise, rgb, wood


def make_box(rng: np.random.Generator) -> Model:
    """A closed box, 60 to 400 mm, of board, tinplate or wood."""
    builders = (_carton, make_lidded, make_lidded, _packet, _packet, _tin, _chest)
    return pick(rng, builders)(rng)


def _carton(rng: np.random.Generator) -> Model:
    """A cardboard carton: four flaps above, a slot between them, tape along it."""
    size = draw_size(rng, (0.16, 0.4), (0.55, 0.95), (0.4, 0.95))
    w, d, h = size
    board = jitter(rng, (0.72, 0.56, 0.38), 0.05)
    crease = rng.uniform(0.0015, 0.003)
    profile = np.array([[crease, 0.0], [0.0, crease], [0.0, 0.5 * h], [0.0, h - crease], [crease, h]])
    body = prism(profile, (w, d), 0.004, [BOTTOM, SIDE, SIDE, SIDE, TOP, TOP], 3, (6, 6))
    slot = straight_prism((w + 0.02, 0.003), h - 0.0015, h + 0.01, 0.0008, OTHER)
    body = split_sides(difference(body, [slot]), SIDE, (SIDE, LID, EXTRA, LID))
    paper = textured(_board(rng, board), 0.85)
    printed = _board(rng, board)
    if chance(rng, 0.7):
        mark = label(rng, board, height=64, width=128, faces=1)
        printed[40:104] = np.where(
            (np.abs(mark.astype(np.int16) - rgb(board)).sum(axis=2) > 40)[..., None], mark, printed[40:104]
        )
    top = _board(rng, board)
    if chance(rng, 0.75):
        tape = pick(rng, ((0.8, 0.68, 0.45), (0.85, 0.83, 0.78), vivid(rng)))
        half = max(2, round(0.5 * 128 * rng.uniform(0.05, 0.07) / d))
        top[64 - half : 64 + half] = rgb(mix(board, tape, 0.8))
    front = textured(printed, 0.85)
    grain = Surface("sides", paper, "box", size=max(size))
    surfaces = (
        on_front("front", front, size, back=False),
        grain,
        over_top("top", textured(top, 0.7), w, d),
        Surface("bottom", solid_color(board, 0.85)),
        on_front("back", front, size, back=True),
        Surface("slot", solid_color(mix(board, BLACK, 0.5), 0.9)),
    )
    return Model(body, surfaces)


def _board(rng: np.random.Generator, color: Color) -> Texture:
    """Cardboard: faint corrugation and fibres."""
    share = 0.5 * noise(rng, 128, 128, 3, 64) + 0.5 * noise(rng, 128, 128, 48, 48)
    return blend(mix(color, WHITE, 0.08), mix(color, BLACK, 0.12), share)


def _packet(rng: np.random.Generator) -> Model:
    """A printed packet: cereals, crackers, tea; a closing seam along the top."""
    size = draw_size(rng, (0.06, 0.2), (0.25, 0.6), (0.9, 1.55))
    w, d, h = size
    b = 0.0015
    profile = np.array([[b, 0.0], [0.0, b], [0.0, 0.5 * h], [0.0, h - b], [b, h]])
    body = prism(profile, (w, d), 0.0025, [BOTTOM, SIDE, SIDE, SIDE, TOP, TOP], 3, (5, 5))
    seam = straight_prism((w + 0.02, 0.0016), h - 0.001, h + 0.01, 0.0004, OTHER)
    body = split_sides(difference(body, [seam.moved(y=d * rng.uniform(-0.2, 0.2))]), SIDE, (SIDE, LID, EXTRA, LID))
    paper = vivid(rng) if chance(rng, 0.75) else pale(rng)
    picture = label(rng, paper, height=160, width=128, faces=1)
    gloss = rng.uniform(0.35, 0.7)
    front = textured(picture, gloss)
    second = bands(rng, [paper, mix(paper, WHITE, 0.6)]) if chance(rng, 0.4) else blank(8, 8, jitter(rng, paper))
    side = Surface("sides", textured(second, gloss), "plane", origin=(0, -d / 2, 0), across=(0, d, 0), up=(0, 0, h))
    surfaces = (
        on_front("front", front, size, back=False),
        side,
        Surface("top", solid_color(jitter(rng, paper, 0.02), gloss)),
        Surface("bottom", solid_color(paper, 0.7)),
        on_front("back", front, size, back=True),
        Surface("seam", solid_color(mix(paper, BLACK, 0.5), 0.8)),
    )
    return Model(body, surfaces)


def _tin(rng: np.random.Generator) -> Model:
    """A tinplate box with round corners and a pressed lid."""
    size = draw_size(rng, (0.08, 0.25), (0.5, 1.0), (0.25, 0.9))
    w, d, h = size
    radius = min(w, d) * rng.uniform(0.12, 0.45)
    deep, b, step = min(0.02, 0.25 * h), 0.003, 0.0012
    t = h - 0.0035
    profile = np.array(
        [
            [b, 0.0],
            [0.4 * b, 0.15 * b],
            [step, b],
            [step, 0.5 * h],
            [step, h - deep],
            [0.0, h - deep + 0.0005],
            [0.0, t - 0.002],
            [0.0012, t - 0.0003],
            [0.12 * min(w, d), t],
            [0.12 * min(w, d) + 0.004, h],
        ]
    )
    body = prism(profile, (w, d), radius, [BOTTOM, BOTTOM, SIDE, SIDE, SIDE, LID, LID, LID, LID, LID, TOP], 6, (2, 2))
    paper = vivid(rng) if chance(rng, 0.7) else pale(rng)
    shine, gloss = (0.5 if chance(rng, 0.4) else 0.0), rng.uniform(0.3, 0.5)
    lid = metal(rng) if chance(rng, 0.3) else solid_color(jitter(rng, paper), gloss, shine)
    picture = label(rng, paper, band_height(0.0, h, 0.5 * (w + d) / 3.14), faces=2)
    surfaces = (
        Surface("side", textured(picture, gloss, shine), "cylinder", low=0.0, high=h - deep),
        Surface("lid", lid),
        Surface("top", lid),
        Surface("bottom", metal(rng)),
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
    light, dark = wood_colors(rng)
    timber = textured(wood(rng, light, dark, size=128), rng.uniform(0.5, 0.8))
    grain = [Surface(name, timber, "box", size=max(size)) for name in ("side", "lid", "top", "bottom")]
    return Model(body, (*grain, Surface("clasp", metal(rng))))
