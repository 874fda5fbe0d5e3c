"""Pure: drink cans, food tins, flat tins, spray cans and paint cans, with rims."""

from collections.abc import Sequence

import numpy as np

from workers.assets.builtin import materials as paint
from workers.assets.builtin.materials import Color, Texture, chance, pick
from workers.assets.builtin.parts import Model, Surface, over_top
from workers.assets.builtin.solid import lathe
from workers.assets.builtin.sweeps import fillet

SIDE, METAL, LID, TOP = 0, 1, 2, 3
SEGMENTS = 48

Outline = tuple[Sequence[float], Sequence[float], Sequence[float], Sequence[int]]
"""A can from the bottom of the axis to its top: radius, height and fillet radius of each of P corners, metres, and the
surface number of the segment that begins there."""


def make_can(rng: np.random.Generator) -> Model:
    """A closed can with rims, 35 to 200 mm high."""
    builders = ((0.4, _drink), (0.75, _food), (0.88, _spray), (1.0, _paint))
    kind = rng.random()
    build = next(build for share, build in builders if kind < share)
    radii, levels, fillets, numbers = (np.array(column) for column in build(rng))
    surface = numbers[:-1]
    profile, owner = fillet(np.column_stack([radii, levels]), fillets, 3)
    solid = lathe(profile, surface[owner], SEGMENTS)
    on_side = np.flatnonzero(surface == SIDE)
    low, high = float(levels[on_side[0]]), float(levels[on_side[-1] + 1])
    lid_radius = float(radii[np.flatnonzero(surface == LID)[0]])
    rows = paint.band_height(low, high, float(radii[on_side[0]]))
    return Model(solid, _surfaces(rng, build is _drink, low, high, rows, lid_radius))


def _drink(rng: np.random.Generator) -> Outline:
    """A drinks can: domed base on a ring, tapered below and above, a rim around a sunken lid."""
    r = float(pick(rng, (0.0265, 0.0289, 0.0331, 0.0331, 0.038)))
    h = r * rng.uniform(3.2, 4.9)
    ring, rim, waist = 0.74 * r, 0.82 * r, 0.06 * (0.13 * r / 0.033) + 0.0032
    return (
        [0.0, 0.6 * ring, ring - 0.003, ring, r, r, rim * 0.985, rim, rim, rim - 0.0022, rim - 0.004, 0.0],
        [0.009, 0.006, 0, 0, waist, h - 0.012 * r / 0.033, h - 0.0024, h - 0.002, h, h, h - 0.006, h - 0.006],
        [0.0, 0.004, 0.0, 0.0, 0.006, 0.006, 0.0, 0.0, 0.0006, 0.0006, 0.0006, 0.0],
        [*[METAL] * 4, SIDE, *[METAL] * 5, LID, LID],
    )


def _food(rng: np.random.Generator) -> Outline:
    """A food tin: straight, often with beads, a double seam at both ends; flat fish tins too."""
    r = rng.uniform(0.03, 0.055)
    h = r * (rng.uniform(0.7, 1.0) if chance(rng, 0.25) else rng.uniform(1.8, 3.2))
    seam, lid = r + 0.0014, h - 0.0045
    count, bead_r, bead_z = 0, np.zeros(0), np.zeros(0)
    if h > 1.5 * r and chance(rng, 0.5):
        count, depth = int(rng.integers(4, 9)), rng.uniform(0.0006, 0.0012)
        step = 0.1 * h / count
        bead_r = np.tile([r, r - depth, r], count)
        bead_z = (np.linspace(0.3 * h, 0.7 * h, count)[:, None] + [-step, 0.0, step]).ravel()
    radii = [0.0, r - 0.004, r - 0.003, seam, seam, r, *bead_r, r, seam, seam]
    levels = [0.003, 0.003, 0.0, 0.0, 0.0042, 0.005, *bead_z, h - 0.005, h - 0.0042, h, h]
    return (
        [*radii, r - 0.0012, r - 0.0025, r * 0.72, r * 0.68, 0.0],
        [*levels, lid, lid, lid + 0.0014, lid + 0.0014],
        [*[0.0] * 3, *[0.0008] * 2, *[0.0] * (2 + 3 * count), *[0.0008] * 2, *[0.0006] * 4, 0.0],
        [*[METAL] * 5, *[SIDE] * (1 + 3 * count), *[METAL] * 4, *[LID] * 4],
    )


def _spray(rng: np.random.Generator) -> Outline:
    """A spray can: tall, domed shoulder, a cap on top."""
    r = rng.uniform(0.022, 0.033)
    h = r * rng.uniform(4.6, 6.4)
    body = h * rng.uniform(0.74, 0.8)
    cap = r * rng.uniform(0.72, 0.97)
    start, seam, crown = body + 0.32 * r, r + 0.0012, cap * rng.uniform(0.85, 1.0)
    return (
        [0.0, 0.7 * r, r - 0.003, seam, seam, r, r, r + 0.001, r + 0.001, cap * 0.95, cap, crown, 0.0],
        [0.006, 0.003, 0.0, 0.0, 0.004, 0.005, body, body + 0.0006, body + 0.003, start, start, h, h],
        [0.0, 0.004, 0.0, 0.0008, 0.0008, 0.0, 0.0, 0.0008, 0.001, 0.0, 0.0, 0.25 * r, 0.0],
        [*[METAL] * 5, SIDE, *[METAL] * 3, TOP, TOP, LID, LID],
    )


def _paint(rng: np.random.Generator) -> Outline:
    """A paint can: wide, with a channelled lid."""
    r = rng.uniform(0.045, 0.085)
    h = r * rng.uniform(1.7, 2.3)
    seam, deep = r + 0.002, h - 0.005
    side = [0.0, r - 0.006, r - 0.004, seam, seam, r, r, seam, seam, r - 0.004]
    channel = [deep, deep, h - 0.001, h - 0.001, deep + 0.001, deep + 0.001]
    return (
        [*side, 0.9 * r, 0.84 * r, 0.8 * r, 0.77 * r, 0.74 * r, 0.0],
        [0.004, 0.004, 0.0, 0.0, 0.005, 0.006, h - 0.007, h - 0.006, h, h, *channel],
        [0.0, 0.0, 0.0, 0.001, 0.001, 0.0, 0.0, *[0.001] * 8, 0.0],
        [*[METAL] * 5, SIDE, *[METAL] * 4, *[LID] * 6],
    )


def _surfaces(
    rng: np.random.Generator, drink: bool, low: float, high: float, rows: int, lid_radius: float
) -> tuple[Surface, ...]:
    bare = paint.steel(rng)
    paper: Color = paint.vivid(rng) if chance(rng, 0.6) else paint.pale(rng)
    if chance(rng, 0.08):
        side = bare
    else:
        if chance(rng, 0.8):
            picture = paint.label(rng, paper, rows, faces=int(rng.integers(2, 4)))
        else:
            picture = paint.bands(rng, [paper, paint.ink_on(rng, paper), paint.vivid(rng)])
        shiny = drink or chance(rng, 0.4)
        roughness = rng.uniform(0.3, 0.5) if shiny else rng.uniform(0.6, 0.8)
        side = paint.textured(picture, roughness, 0.35 if drink else 0.0)
    lid = Surface("lid", bare)
    if drink:
        opener = paint.textured(_opener(bare.base_color[:3]), bare.roughness, 1.0)
        lid = over_top("lid", opener, 2 * lid_radius, 2 * lid_radius)
    top = paint.plastic(rng) if chance(rng, 0.8) else paint.solid_color(paint.mix(paper, (0.95, 0.95, 0.95), 0.5), 0.5)
    return Surface("side", side, "cylinder", low=low, high=high), Surface("metal", bare), lid, Surface("cap", top)


def _opener(color: Color) -> Texture:
    """A drinks lid seen from above: the score line of the mouth, and the ring pull."""
    picture = paint.blank(64, 64, color)
    y, x = (np.arange(64)[:, None] - 31.5) / 32, (np.arange(64)[None] - 31.5) / 32
    mouth = (x / 0.3) ** 2 + ((y - 0.42) / 0.4) ** 2
    picture[np.abs(mouth - 1.0) < 0.14] = paint.rgb(paint.mix(color, (0.2, 0.2, 0.2), 0.6))
    tab = (x / 0.2) ** 2 + ((y + 0.16) / 0.4) ** 2
    hole = (x / 0.11) ** 2 + ((y + 0.3) / 0.14) ** 2
    picture[(tab < 1.0) & (hole > 1.0)] = paint.rgb(paint.mix(color, (1.0, 1.0, 1.0), 0.4))
    picture[(np.abs(tab - 1.0) < 0.16) | (np.abs(hole - 1.0) < 0.3)] = paint.rgb(paint.mix(color, (0.1, 0.1, 0.1), 0.6))
    return picture
