"""Pure: drink cans, food tins, flat tins, spray cans and paint cans, with rims."""

import numpy as np

from schemas.base import Array
from workers.assets.builtin.curves import fillet
from workers.assets.builtin.draws import chance, pick
from workers.assets.builtin.materials import plastic, solid_color, steel, textured
from workers.assets.builtin.palette import Color, ink_on, mix, pale, vivid
from workers.assets.builtin.parts import Model, Surface, over_top
from workers.assets.builtin.solid import lathe
from workers.assets.builtin.textures import Texture, band_height, bands, blank, label, rgb

SIDE, METAL, LID, TOP = 0, 1, 2, 3
SEGMENTS = 48

# The outline of a can is [P, 4], from the bottom of the axis to its top: radius, height, and fillet radius of each
# corner, metres, and the surface number of the segment that begins there.


def make_can(rng: np.random.Generator) -> Model:
    """A closed can with rims, 35 to 200 mm high."""
    builders = ((0.4, _drink), (0.75, _food), (0.88, _spray), (1.0, _paint))
    kind = rng.random()
    build = next(build for share, build in builders if kind < share)
    outline = build(rng)
    surface = outline[:-1, 3].astype(np.int64)
    profile, owner = fillet(outline[:, :2], outline[:, 2], 3)
    solid = lathe(profile, surface[owner], SEGMENTS)
    on_side = np.flatnonzero(surface == SIDE)
    low, high = float(outline[on_side[0], 1]), float(outline[on_side[-1] + 1, 1])
    lid_radius = float(outline[np.flatnonzero(surface == LID)[0], 0])
    rows = band_height(low, high, float(outline[on_side[0], 0]))
    return Model(solid, _surfaces(rng, build is _drink, (low, high, rows), lid_radius))


def _drink(rng: np.random.Generator) -> Array:
    """A drinks can: domed base on a ring, tapered below and above, a rim around a sunken lid."""
    radius = float(pick(rng, (0.0265, 0.0289, 0.0331, 0.0331, 0.038)))
    height = radius * rng.uniform(3.2, 4.9)
    ring, rim = 0.74 * radius, 0.82 * radius
    taper = 0.13 * radius / 0.033
    return np.array(
        [
            [0.0, 0.009, 0.0, METAL],
            [0.6 * ring, 0.006, 0.004, METAL],
            [ring - 0.003, 0.0, 0.0, METAL],
            [ring, 0.0, 0.0, METAL],
            [radius, 0.06 * taper + 0.0032, 0.006, SIDE],
            [radius, height - 0.012 * radius / 0.033, 0.006, METAL],
            [rim * 0.985, height - 0.0024, 0.0, METAL],
            [rim, height - 0.002, 0.0, METAL],
            [rim, height, 0.0006, METAL],
            [rim - 0.0022, height, 0.0006, METAL],
            [rim - 0.004, height - 0.006, 0.0006, LID],
            [0.0, height - 0.006, 0.0, LID],
        ]
    )


def _food(rng: np.random.Generator) -> Array:
    """A food tin: straight, often with beads, a double seam at both ends; flat fish tins too."""
    radius = rng.uniform(0.03, 0.055)
    height = radius * (rng.uniform(0.7, 1.0) if chance(rng, 0.25) else rng.uniform(1.8, 3.2))
    seam, deep = 0.0014, 0.0045
    lower = [
        [0.0, 0.003, 0.0, METAL],
        [radius - 0.004, 0.003, 0.0, METAL],
        [radius - 0.003, 0.0, 0.0, METAL],
        [radius + seam, 0.0, 0.0008, METAL],
        [radius + seam, 0.0042, 0.0008, METAL],
        [radius, 0.005, 0.0, SIDE],
    ]
    upper = [
        [radius, height - 0.005, 0.0, METAL],
        [radius + seam, height - 0.0042, 0.0008, METAL],
        [radius + seam, height, 0.0008, METAL],
        [radius - 0.0012, height, 0.0006, METAL],
        [radius - 0.0025, height - deep, 0.0006, LID],
        [radius * 0.72, height - deep, 0.0006, LID],
        [radius * 0.68, height - deep + 0.0014, 0.0006, LID],
        [0.0, height - deep + 0.0014, 0.0, LID],
    ]
    middle: list[list[float]] = []
    if height > 1.5 * radius and chance(rng, 0.5):
        count, depth = int(rng.integers(4, 9)), rng.uniform(0.0006, 0.0012)
        for z in np.linspace(0.3 * height, 0.7 * height, count):
            step = 0.1 * height / count
            middle += [[r, at, 0.0, SIDE] for r, at in ((radius, z - step), (radius - depth, z), (radius, z + step))]
    return np.array(lower + middle + upper)


def _spray(rng: np.random.Generator) -> Array:
    """A spray can: tall, domed shoulder, a cap on top."""
    radius = rng.uniform(0.022, 0.033)
    height = radius * rng.uniform(4.6, 6.4)
    body = height * rng.uniform(0.74, 0.8)
    cap = radius * rng.uniform(0.72, 0.97)
    start = body + 0.32 * radius
    return np.array(
        [
            [0.0, 0.006, 0.0, METAL],
            [0.7 * radius, 0.003, 0.004, METAL],
            [radius - 0.003, 0.0, 0.0, METAL],
            [radius + 0.0012, 0.0, 0.0008, METAL],
            [radius + 0.0012, 0.004, 0.0008, METAL],
            [radius, 0.005, 0.0, SIDE],
            [radius, body, 0.0, METAL],
            [radius + 0.001, body + 0.0006, 0.0008, METAL],
            [radius + 0.001, body + 0.003, 0.001, METAL],
            [cap * 0.95, start, 0.0, TOP],
            [cap, start, 0.0, TOP],
            [cap * rng.uniform(0.85, 1.0), height, 0.25 * radius, LID],
            [0.0, height, 0.0, LID],
        ]
    )


def _paint(rng: np.random.Generator) -> Array:
    """A paint can: wide, with a channelled lid."""
    radius = rng.uniform(0.045, 0.085)
    height = radius * rng.uniform(1.7, 2.3)
    seam, deep = 0.002, 0.005
    return np.array(
        [
            [0.0, 0.004, 0.0, METAL],
            [radius - 0.006, 0.004, 0.0, METAL],
            [radius - 0.004, 0.0, 0.0, METAL],
            [radius + seam, 0.0, 0.001, METAL],
            [radius + seam, 0.005, 0.001, METAL],
            [radius, 0.006, 0.0, SIDE],
            [radius, height - 0.007, 0.0, METAL],
            [radius + seam, height - 0.006, 0.001, METAL],
            [radius + seam, height, 0.001, METAL],
            [radius - 0.004, height, 0.001, METAL],
            [0.9 * radius, height - deep, 0.001, LID],
            [0.84 * radius, height - deep, 0.001, LID],
            [0.8 * radius, height - 0.001, 0.001, LID],
            [0.77 * radius, height - 0.001, 0.001, LID],
            [0.74 * radius, height - deep + 0.001, 0.001, LID],
            [0.0, height - deep + 0.001, 0.0, LID],
        ]
    )


def _surfaces(
    rng: np.random.Generator, drink: bool, side_span: tuple[float, float, int], lid_radius: float
) -> tuple[Surface, ...]:
    low, high, rows = side_span
    bare = steel(rng)
    paper: Color = vivid(rng) if chance(rng, 0.6) else pale(rng)
    if chance(rng, 0.08):
        side, mapping = bare, False
    else:
        picture = (
            label(rng, paper, rows, faces=int(rng.integers(2, 4)))
            if chance(rng, 0.8)
            else bands(rng, [paper, ink_on(rng, paper), vivid(rng)])
        )
        shiny = drink or chance(rng, 0.4)
        side, mapping = (
            textured(picture, (rng.uniform(0.3, 0.5) if shiny else rng.uniform(0.6, 0.8)), 0.35 if drink else 0.0),
            True,
        )
    lid = Surface("lid", bare)
    if drink:
        opener = textured(_opener(bare.base_color[:3]), bare.roughness, 1.0)
        lid = over_top("lid", opener, 2 * lid_radius, 2 * lid_radius)
    top = plastic(rng) if chance(rng, 0.8) else solid_color(mix(paper, (0.95, 0.95, 0.95), 0.5), 0.5)
    return (
        Surface("side", side, "cylinder" if mapping else "none", low=low, high=high),
        Surface("metal", bare),
        lid,
        Surface("cap", top),
    )


def _opener(color: Color) -> Texture:
    """A drinks lid seen from above: the score line of the mouth, and the ring pull."""
    picture = blank(64, 64, color)
    y, x = (np.arange(64)[:, None] - 31.5) / 32, (np.arange(64)[None] - 31.5) / 32
    mouth = (x / 0.3) ** 2 + ((y - 0.42) / 0.4) ** 2
    picture[np.abs(mouth - 1.0) < 0.14] = rgb(mix(color, (0.2, 0.2, 0.2), 0.6))
    tab = (x / 0.2) ** 2 + ((y + 0.16) / 0.4) ** 2
    hole = (x / 0.11) ** 2 + ((y + 0.3) / 0.14) ** 2
    picture[(tab < 1.0) & (hole > 1.0)] = rgb(mix(color, (1.0, 1.0, 1.0), 0.4))
    picture[(np.abs(tab - 1.0) < 0.16) | (np.abs(hole - 1.0) < 0.3)] = rgb(mix(color, (0.1, 0.1, 0.1), 0.6))
    return picture
