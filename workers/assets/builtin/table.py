"""Pure: tables: round, oval, square and rectangular, of wood, stone or paint."""

import numpy as np

from workers.assets.builtin.curves import squircle
from workers.assets.builtin.draws import chance, pick
from workers.assets.builtin.materials import metal, solid_color, textured
from workers.assets.builtin.palette import BLACK, WHITE, jitter, mix, pale, vivid, wood_colors
from workers.assets.builtin.parts import Model, Surface, UvMapping
from workers.assets.builtin.solid import Solid, level_ring, loft, union
from workers.assets.builtin.sweeps import prism
from workers.assets.builtin.table_base import TOP, TableSize, make_base
from workers.assets.builtin.textures import speckled, stone, wood


def make_table(rng: np.random.Generator) -> Model:
    """A table 0.45 to 0.9 m high, its flat top 0.9 to 1.8 m across and 15 to 45 mm thick, exactly level."""
    round_top = chance(rng, 0.35)
    width = rng.uniform(0.9, 1.4) if round_top else rng.uniform(0.9, 1.8)
    depth = width if round_top and chance(rng, 0.6) else max(0.8, width * rng.uniform(0.55, 1.0))
    height = rng.uniform(0.68, 0.8) if chance(rng, 0.6) else rng.uniform(0.45, 0.9)
    plan = TableSize(width, depth, rng.uniform(0.015, 0.045), height, round_top)
    return Model(union([_top(rng, plan), *make_base(rng, plan)]), _surfaces(rng, plan))


def _top(rng: np.random.Generator, plan: TableSize) -> Solid:
    edge = min(rng.uniform(0.001, 0.008), 0.3 * plan.thick)
    low, high = plan.under, plan.height
    profile = np.array(
        [[edge, low], [0.0, low + edge], [0.0, high - edge], [0.3 * edge, high - 0.3 * edge], [edge, high]]
    )
    if plan.round_top:
        outline = squircle(48, 0) * np.array([0.5 * plan.width, 0.5 * plan.depth])
        rings = [level_ring(outline * (1 - 2 * inset / plan.depth), z) for inset, z in profile]
        ends = np.array([[0.0, 0.0, low], [0.0, 0.0, high]])
        return loft(np.stack(rings), ends[0], ends[1], [TOP] * 6, [0, 1, 2, 3, 3, 4])
    radius = edge + (rng.uniform(0.002, 0.02) if chance(rng, 0.6) else rng.uniform(0.03, 0.15))
    return prism(profile, (plan.width, plan.depth), radius, [TOP] * 6, 4)


def _surfaces(rng: np.random.Generator, plan: TableSize) -> tuple[Surface, ...]:
    light, dark = wood_colors(rng)
    long = max(plan.width, plan.depth)
    timber = textured(wood(rng, light, dark, planks=int(rng.integers(0, 8))), rng.uniform(0.35, 0.7))
    kind = rng.random()
    if kind < 0.55:
        top = Surface("top", timber, "box", size=long, grain=0)
    elif kind < 0.72:
        pair = pick(
            rng,
            ((WHITE, (0.6, 0.6, 0.62)), ((0.2, 0.2, 0.21), (0.5, 0.5, 0.5)), ((0.75, 0.68, 0.6), (0.5, 0.42, 0.35))),
        )
        top = Surface("top", textured(stone(rng, *pair), rng.uniform(0.15, 0.4)), "box", size=long)
    elif kind < 0.8:
        ground = pale(rng)
        spots = speckled(rng, ground, mix(ground, BLACK, 0.5), 0.04, 192, 192)
        top = Surface("top", textured(spots, 0.4), "box", size=long)
    else:
        paint = pick(rng, (WHITE, (0.85, 0.85, 0.84), BLACK, (0.3, 0.32, 0.34), vivid(rng)))
        top = Surface("top", solid_color(jitter(rng, paint), rng.uniform(0.3, 0.6)))
    matching = top.material is timber and chance(rng, 0.7)
    legs = timber if matching or not chance(rng, 0.5) else metal(rng)
    mapping: UvMapping = "box" if legs is timber else "none"
    return top, Surface("legs", legs, mapping, size=long, grain=2), Surface("frame", legs, mapping, size=long, grain=0)
