"""Pure: open vessels: bowls, round and soft-square; mugs and cups with one handle; jars, pots and vases, some with two ears."""

from dataclasses import replace

import numpy as np

from schemas.base import Array
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
        bare = paint.steel(rng)
        return Surface("outside", bare), Surface("inside", bare), Surface("base", bare)
    if kind < 0.32:
        light, dark = paint.wood_colors(rng)
        timber = paint.textured(paint.wood(rng, light, dark, size=128), rng.uniform(0.45, 0.7))
        # The grain runs along x through the whole block that the bowl was turned from: no seam anywhere.
        reach = float(wall.profile[:, 0].max())
        across, up = (2 * reach, 0.0, 0.0), (0.0, 1.6 * reach, 1.2 * reach)
        block = Surface("block", timber, "plane", origin=(-reach, -reach, 0.0), across=across, up=up)
        return tuple(replace(block, name=name) for name in ("outside", "inside", "base"))
    return _pottery(rng, high, float(wall.profile[:, 0].max()))


def _pottery(rng: np.random.Generator, high: float, radius: float) -> tuple[Surface, Surface, Surface]:
    roughness = rng.uniform(0.15, 0.4) if chance(rng, 0.75) else rng.uniform(0.6, 0.85)
    ground = paint.glaze_color(rng)
    inside = ground if chance(rng, 0.45) else paint.jitter(rng, paint.WHITE, 0.03)
    outside = paint.solid_color(ground, roughness)
    if chance(rng, 0.55):
        ink, rows = paint.ink_on(rng, ground), paint.band_height(0.0, 1.4 * high, 0.75 * radius)
        painters = (
            lambda: paint.bands(rng, [ground, paint.mix(ground, ink, 0.7), paint.pale(rng)]),
            lambda: paint.upright_stripes(rng, [ground, ground, paint.mix(ground, ink, 0.6)]),
            lambda: paint.dots(rng, ground, paint.mix(ground, ink, 0.8), rows),
            lambda: paint.flecked(rng, ground, rows),
        )
        outside = paint.textured(pick(rng, painters)(), roughness)
    first = Surface("outside", outside, "cylinder", low=0.0, high=high)
    base = paint.solid_color(paint.mix(ground, (0.75, 0.7, 0.62), 0.6), 0.8)
    return first, Surface("inside", paint.solid_color(inside, roughness)), Surface("base", base)


HANDLE = 3


def make_mug(rng: np.random.Generator) -> Model:
    """A mug: straight, tapered, bellied or bell-shaped, 55 to 115 mm high, glazed or enamelled."""
    wall = _body(rng)
    solid = with_handles(lathe(wall.profile, wall.surface, 40), OUTSIDE, [_handle(rng, wall)])
    return Model(solid, _surfaces_mug(rng, wall))


def _body(rng: np.random.Generator) -> Wall:
    height = rng.uniform(0.055, 0.07) if chance(rng, 0.2) else rng.uniform(0.078, 0.115)
    radius = min(height * rng.uniform(0.36, 0.52), rng.uniform(0.042, 0.05))
    thickness = rng.uniform(0.003, 0.005)
    bottom = thickness + rng.uniform(0.001, 0.004)
    kind = int(rng.integers(5))
    if kind <= 1:  # straight or tapered
        taper = rng.uniform(0.7, 1.0)
        wall = np.array([[radius * taper, bottom], [radius, height]])
    elif kind == 2:  # bellied
        belly, rim = radius * rng.uniform(1.05, 1.2), radius * rng.uniform(0.85, 1.0)
        wall = spline(np.array([[radius * 0.85, bottom], [belly, 0.45 * height], [rim, height]]), 4)
    elif kind == 3:  # bell
        waist = radius * rng.uniform(0.72, 0.85)
        wall = bezier([waist, bottom], [waist, 0.55 * height], [radius * 0.9, 0.8 * height], [radius * 1.03, height], 8)
    else:  # a cup that opens from a round bottom
        foot, mouth = [radius * 0.55, bottom], [radius * 1.05, height]
        wall = bezier(foot, [radius * 0.95, bottom + 0.04 * height], [radius, 0.5 * height], mouth, 9)
    bend = [0.0, rng.uniform(0.004, 0.014), *[0.0] * (len(wall) - 1)]
    hollow, _ = fillet(np.concatenate([[[0.0, bottom]], wall]), bend, 3)
    foot_radius = wall[0, 0] * rng.uniform(0.72, 0.88)
    return wall_around(hollow, thickness, foot_radius, rng.uniform(0.003, 0.005), rng.uniform(0.0008, 0.002))


def _handle(rng: np.random.Generator, wall: Wall) -> Solid:
    top, bottom = float(wall.outer[-1, 1]), float(wall.outer[1, 1])
    span = top - bottom
    high, low = top - span * rng.uniform(0.1, 0.2), bottom + span * rng.uniform(0.16, 0.3)
    half_width = min(rng.uniform(0.005, 0.0095), 0.12 * span)
    # The end of the rod stays within the wall: half a chord of the wall's circle sinks by w^2 / 2r.
    half_width = min(half_width, float(np.sqrt(0.6 * wall.thickness_m * wall.radius_at(low))))
    slender = rng.uniform(0.5, 0.85)
    start, stop = wall.middle_at(high), wall.middle_at(low)
    out = wall.normal_at(high), wall.normal_at(low)
    reach = (high - low) * rng.uniform(0.5, 0.8)
    path = _path(rng, start, out[0], stop, out[1], max(reach, 0.022))
    half_depth = min(half_width * slender, 0.8 * bend_radius(path, (out[0], -out[1])))
    along = 2.0 * np.linspace(0.0, 1.0, len(path)) - 1.0
    thick_ends = 1.0 + rng.uniform(0.0, 0.25) * (along * along) * (along * along)
    section = squircle(12, int(rng.integers(2))) * np.array([half_width, half_depth]) / 1.25
    return rod(path, section, HANDLE, (out[0], -out[1]), thick_ends)


def _path(rng: np.random.Generator, start: Array, out: Array, stop: Array, back: Array, reach: float) -> Array:
    """[K, 2] of (x, z): from the upper end to the lower one; perpendicular to the wall at both."""
    kind = int(rng.integers(3))
    if kind == 0:  # a round C
        return bezier(start, start + 1.25 * reach * out, stop + 1.25 * reach * back, stop, 14)
    if kind == 1:  # an ear: wide above, narrow below
        return bezier(start, start + 1.6 * reach * out, stop + 0.7 * reach * back, stop, 14)
    corners = np.array([start, start + reach * out, stop + reach * rng.uniform(0.8, 1.0) * back, stop])
    size = 0.42 * float(np.sqrt(((corners[1] - corners[2]) ** 2).sum()))
    path, _ = fillet(corners, [0.0, size, size, 0.0], 5)
    return path


def _surfaces_mug(rng: np.random.Generator, wall: Wall) -> tuple[Surface, ...]:
    low, high = float(wall.outer[0, 1]), float(wall.profile[:, 1].max())
    roughness = rng.uniform(0.15, 0.35) if chance(rng, 0.75) else rng.uniform(0.6, 0.85)
    ground = paint.jitter(rng, paint.WHITE, 0.03) if chance(rng, 0.35) else paint.glaze_color(rng)
    inside = ground if chance(rng, 0.5) else paint.jitter(rng, paint.WHITE, 0.03)
    body = paint.solid_color(ground, roughness)
    if chance(rng, 0.55):
        height = paint.band_height(low, high, wall.radius_at(0.5 * high))
        painters = (
            lambda: paint.bands(rng, [ground, paint.ink_on(rng, ground), paint.pale(rng)]),
            lambda: paint.label(rng, ground, height),
            lambda: paint.dots(rng, ground, paint.ink_on(rng, ground), height),
            lambda: paint.upright_stripes(rng, [ground, ground, paint.mix(ground, paint.ink_on(rng, ground), 0.7)]),
            lambda: paint.flecked(rng, ground, height),
        )
        body = paint.textured(pick(rng, painters)(), roughness)
    grip = ground if chance(rng, 0.75) else paint.vivid(rng)
    handle = paint.metal(rng) if chance(rng, 0.06) else paint.solid_color(grip, roughness)
    base = paint.solid_color(paint.mix(ground, (0.75, 0.7, 0.62), 0.6), 0.8)
    return (
        Surface("body", body, "cylinder", low=low, high=high),
        Surface("inside", paint.solid_color(inside, roughness)),
        Surface("base", base),
        Surface("handle", handle),
    )


# ---------------------------------------------------------------------------------------------- jars

EAR = 3
JAR_SEGMENTS = 40


def make_jar(rng: np.random.Generator) -> Model:
    """An open jar, 80 to 320 mm high: of glass with a label, or of pottery, some with two ears."""
    glass = chance(rng, 0.4)
    wall = _glass_jar(rng) if glass else _pot(rng)
    section = None
    if glass and chance(rng, 0.3):
        # A soft square that turns into a circle at the neck; it depends on the height alone.
        z = wall.profile[1:-1, 1]
        section = rounded_sections(
            0.96 * squircle(JAR_SEGMENTS, 1), np.clip((0.78 * z.max() - z) / (0.2 * z.max()), 0.0, 1.0)
        )
    body = lathe(wall.profile, wall.surface, JAR_SEGMENTS, section)
    if not glass and chance(rng, 0.3):
        body = with_handles(body, OUTSIDE, _ears(rng, wall))
    return Model(body, _surfaces_jar(rng, wall, glass))


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


def _surfaces_jar(rng: np.random.Generator, wall: Wall, glass: bool) -> tuple[Surface, ...]:
    high = float(wall.profile[:, 1].max())
    rows = paint.band_height(0.0, high, float(wall.outer[:, 0].max()))
    if glass:
        tint = paint.jitter(rng, pick(rng, ((0.74, 0.83, 0.83), (0.66, 0.76, 0.74), (0.32, 0.2, 0.1))), 0.04)
        outside = base = paint.clear_glass(tint, rng.uniform(0.08, 0.2))
        inside = replace(base, ior=1.0)
        if chance(rng, 0.6):
            outside = _on_glass(rng, tint, rows)
    else:
        outside, inside, base = _pottery_jar(rng, rows)
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


def _pottery_jar(rng: np.random.Generator, rows: int) -> tuple[Material, Material, Material]:
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
