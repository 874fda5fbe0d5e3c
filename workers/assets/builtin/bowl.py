"""Pure: bowls, round and soft-square."""

from dataclasses import replace

import numpy as np

from workers.assets.builtin.curves import bezier, rounded_sections, squircle
from workers.assets.builtin.hollow import Wall, wall_around
from workers.assets.builtin.materials import solid_color, steel, textured
from workers.assets.builtin.palette import WHITE, chance, glaze_color, ink_on, jitter, mix, pale, pick, wood_colors
from workers.assets.builtin.parts import Model, Surface
from workers.assets.builtin.solid import lathe
from workers.assets.builtin.textures import band_height, bands, dots, flecked, upright_stripes, wood


def make_bowl(rng: np.random.Generator) -> Model:
    """A bowl, 110 to 300 mm across: of pottery, wood or steel, with a foot ring."""
    radius = rng.uniform(0.055, 0.15)
    thickness = rng.uniform(0.0035, 0.006)
    depth = radius * rng.uniform(0.55, 1.05)
    foot_height = rng.uniform(0.002, 0.008)
    bottom = foot_height + thickness
    flat, flare = rng.uniform(0.35, 0.75), rng.uniform(0.75, 1.0)
    bend = [radius * flat * 1.3, bottom], [radius * flare, bottom + depth * rng.uniform(0.15, 0.55)]
    hollow = bezier([0.0, bottom], *bend, [radius, bottom + depth], 15)
    foot = radius * rng.uniform(0.38, 0.55)
    wall = wall_around(hollow, thickness, foot, rng.uniform(0.004, 0.007), 0.7 * foot_height)
    section = None
    if chance(rng, 0.15):
        # Round at the foot and a soft square at the rim; it depends on the radius alone.
        section = rounded_sections(squircle(56, 1), np.clip((wall.profile[1:-1, 0] - foot) / (radius - foot), 0.0, 1.0))
    return Model(lathe(wall.profile, wall.surface, 56, section), _surfaces(rng, wall))


def _surfaces(rng: np.random.Generator, wall: Wall) -> tuple[Surface, ...]:
    high = float(wall.profile[:, 1].max())
    kind = rng.random()
    if kind < 0.12:
        metal = steel(rng)
        return Surface("outside", metal), Surface("inside", metal), Surface("base", metal)
    if kind < 0.32:
        light, dark = wood_colors(rng)
        timber = textured(wood(rng, light, dark, size=128), rng.uniform(0.45, 0.7))
        # The grain runs along x through the whole block that the bowl was turned from: no seam anywhere.
        reach = float(wall.profile[:, 0].max())
        across, up = (2 * reach, 0.0, 0.0), (0.0, 1.6 * reach, 1.2 * reach)
        block = Surface("block", timber, "plane", origin=(-reach, -reach, 0.0), across=across, up=up)
        return tuple(replace(block, name=name) for name in ("outside", "inside", "base"))
    return _pottery(rng, high, float(wall.profile[:, 0].max()))


def _pottery(rng: np.random.Generator, high: float, radius: float) -> tuple[Surface, Surface, Surface]:
    roughness = rng.uniform(0.15, 0.4) if chance(rng, 0.75) else rng.uniform(0.6, 0.85)
    ground = glaze_color(rng)
    inside = ground if chance(rng, 0.45) else jitter(rng, WHITE, 0.03)
    outside = solid_color(ground, roughness)
    if chance(rng, 0.55):
        ink, rows = ink_on(rng, ground), band_height(0.0, 1.4 * high, 0.75 * radius)
        painters = (
            lambda: bands(rng, [ground, mix(ground, ink, 0.7), pale(rng)]),
            lambda: upright_stripes(rng, [ground, ground, mix(ground, ink, 0.6)]),
            lambda: dots(rng, ground, mix(ground, ink, 0.8), rows),
            lambda: flecked(rng, ground, rows),
        )
        outside = textured(pick(rng, painters)(), roughness)
    first = Surface("outside", outside, "cylinder", low=0.0, high=high)
    base = solid_color(mix(ground, (0.75, 0.7, 0.62), 0.6), 0.8)
    return first, Surface("inside", solid_color(inside, roughness)), Surface("base", base)
