"""Pure: open jars: preserving jars, pots, vases, urns with two ears."""

from dataclasses import replace

import numpy as np

from schemas.scene.shape import Material
from workers.assets.builtin import materials as paint
from workers.assets.builtin.materials import Color, chance, pick
from workers.assets.builtin.parts import Model, Surface
from workers.assets.builtin.solid import Solid, circle, lathe
from workers.assets.builtin.sweeps import (
    OUTSIDE,
    Wall,
    bend_radius,
    bezier,
    fillet,
    rod,
    rounded_sections,
    spline,
    squircle,
    wall_around,
    with_handles,
)

EAR = 3
SEGMENTS = 40


def make_jar(rng: np.random.Generator) -> Model:
    """An open jar, 80 to 320 mm high: of glass with a label, or of pottery, some with two ears."""
    glass = chance(rng, 0.4)
    wall = _glass_jar(rng) if glass else _pot(rng)
    section = None
    if glass and chance(rng, 0.3):
        # A soft square that turns into a circle at the neck; it depends on the height alone.
        z = wall.profile[1:-1, 1]
        section = rounded_sections(
            0.96 * squircle(SEGMENTS, 1), np.clip((0.78 * z.max() - z) / (0.2 * z.max()), 0.0, 1.0)
        )
    body = lathe(wall.profile, wall.surface, SEGMENTS, section)
    if not glass and chance(rng, 0.3):
        body = with_handles(body, OUTSIDE, _ears(rng, wall))
    return Model(body, _surfaces(rng, wall, glass))


def _glass_jar(rng: np.random.Generator) -> Wall:
    """A preserving jar: straight, a short shoulder, a neck with a thread and no lid."""
    height = rng.uniform(0.08, 0.2)
    radius = height * rng.uniform(0.28, 0.48)
    thickness = rng.uniform(0.0028, 0.0042)
    bottom = thickness + 0.002
    neck = radius * rng.uniform(0.76, 0.9)
    shoulder = height * rng.uniform(0.72, 0.82)
    # The bend into the neck is wider than the wall is thick, so that the wall's outside does not fold over.
    drop = max(0.9 * (radius - neck), 2.2 * thickness)
    below, above = [radius, shoulder - 0.25 * drop], [neck, shoulder - 0.45 * drop]
    arc = bezier([radius, shoulder - drop], below, above, [neck, shoulder + drop], 9)
    corners = np.concatenate([[[0.0, bottom], [radius, bottom]], arc, [[neck, height]]])
    hollow, _ = fillet(corners, [0.0, rng.uniform(0.006, 0.014), *[0.0] * (len(corners) - 2)], 4)
    wall = wall_around(hollow, thickness, 0.82 * radius, 0.006, 0.0015)
    return _with_thread(wall, height)


def _with_thread(wall: Wall, height: float) -> Wall:
    """Two beads around the neck, where a lid would grip."""
    at = int(np.flatnonzero(wall.profile[:, 1] >= height - 1e-9)[0])
    neck, top = wall.profile[at]
    low = wall.profile[at - 1, 1]
    if (room := top - low) < 0.014:
        return wall
    z = low + np.array([[0.35], [0.7]]) * room + [-0.0022, -0.0007, 0.0007, 0.0022]
    bead = neck + 0.0012
    extra = np.column_stack([np.tile([neck, bead, bead, neck], 2), z.ravel()])
    profile = np.concatenate([wall.profile[:at], extra, wall.profile[at:]])
    surface = np.concatenate([wall.surface[:at], np.full(len(extra), OUTSIDE), wall.surface[at:]])
    return Wall(profile, surface, wall.outer, wall.thickness_m)


def _pot(rng: np.random.Generator) -> Wall:
    """A pot or vase: radii drawn at foot, belly, neck and lip."""
    height = rng.uniform(0.12, 0.32)
    belly = height * rng.uniform(0.26, 0.42)
    thickness = rng.uniform(0.004, 0.007)
    bottom = thickness + 0.003
    foot = belly * rng.uniform(0.5, 0.75)
    neck = belly * rng.uniform(0.4, 0.8)
    lip = neck * rng.uniform(1.05, 1.35)
    at = rng.uniform(0.4, 0.62)
    radii = [foot, foot + 0.75 * (belly - foot), belly, neck + 0.28 * (belly - neck), neck, lip]
    levels = bottom + np.array([0.0, 0.5 * at, at, at + 0.65 * (0.86 - at), 0.88]) * (height - bottom)
    points = np.column_stack([radii, [*levels, height]])
    hollow = np.concatenate([[[0.0, bottom]], spline(points, 3)])
    hollow, _ = fillet(hollow, [0.0, 0.006, *[0.0] * (len(hollow) - 2)], 3)
    return wall_around(hollow, thickness, 0.9 * foot, 0.006, 0.002)


def _ears(rng: np.random.Generator, wall: Wall) -> list[Solid]:
    """Two ears, opposite one another, from the shoulder up to the neck."""
    height = float(wall.profile[:, 1].max())
    heights = height * rng.uniform(0.8, 0.86), height * rng.uniform(0.52, 0.62)
    half = min(0.055 * height, float(np.sqrt(0.6 * wall.thickness_m * wall.radius_at(heights[0]))))
    start, stop = (wall.middle_at(z) for z in heights)
    out = [wall.normal_at(z) for z in heights]
    reach = (heights[0] - heights[1]) * rng.uniform(0.6, 1.0)
    path = bezier(start, start + reach * out[0], stop + reach * out[1], stop, 11)
    section = circle(10) * np.array([half, min(0.6 * half, 0.8 * bend_radius(path, (out[0], -out[1])))])
    ear = rod(path, section, EAR, (out[0], -out[1]))
    turned = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    return [ear, ear.placed(turned, np.zeros(3))]


def _surfaces(rng: np.random.Generator, wall: Wall, glass: bool) -> tuple[Surface, ...]:
    high = float(wall.profile[:, 1].max())
    rows = paint.band_height(0.0, high, float(wall.outer[:, 0].max()))
    if glass:
        tint = paint.jitter(rng, pick(rng, ((0.74, 0.83, 0.83), (0.66, 0.76, 0.74), (0.32, 0.2, 0.1))), 0.04)
        outside = base = paint.clear_glass(tint, rng.uniform(0.08, 0.2))
        inside = replace(base, ior=1.0)
        if chance(rng, 0.6):
            outside = _on_glass(rng, tint, rows)
    else:
        outside, inside, base = _pottery(rng, rows)
    return (
        Surface("outside", outside, "cylinder", low=0.0, high=high),
        Surface("inside", inside),
        Surface("base", base),
        Surface("ears", paint.solid_color(inside.base_color[:3], inside.roughness)),
    )


def _on_glass(rng: np.random.Generator, tint: Color, rows: int) -> Material:
    """A glass with a paper label around its middle."""
    paper = paint.pale(rng) if chance(rng, 0.6) else (0.92, 0.9, 0.84)
    printed = paint.label(rng, paper, height=rows // 2)
    picture = paint.blank(rows, 256, tint)
    top = int(0.36 * rows)
    picture[top : top + len(printed)] = printed
    clear = np.full(picture.shape[:2], 255, np.uint8)
    clear[top : top + len(printed)] = 0
    clear.setflags(write=False)
    return replace(paint.textured(picture, 0.35), transmission=1.0, transmission_map=clear)


def _pottery(rng: np.random.Generator, rows: int) -> tuple[Material, Material, Material]:
    roughness = rng.uniform(0.15, 0.4) if chance(rng, 0.6) else rng.uniform(0.65, 0.9)
    ground = paint.jitter(rng, (0.68, 0.4, 0.27), 0.06) if chance(rng, 0.2) else paint.glaze_color(rng)
    plain = paint.solid_color(ground, roughness)
    base = paint.solid_color(paint.mix(ground, (0.7, 0.6, 0.5), 0.6), 0.85)
    if chance(rng, 0.4):
        return plain, plain, base
    ink = paint.ink_on(rng, ground)
    painters = (
        lambda: paint.bands(rng, [ground, paint.mix(ground, ink, 0.7), paint.pale(rng)]),
        lambda: paint.upright_stripes(rng, [ground, ground, paint.mix(ground, ink, 0.5)]),
        lambda: paint.dots(rng, ground, paint.mix(ground, ink, 0.7), rows),
        lambda: paint.flecked(rng, ground, rows),
        lambda: paint.bands(rng, [ground, paint.WHITE, ink]),
    )
    return paint.textured(pick(rng, painters)(), roughness), plain, base
