"""Pure: bowls, round and soft-square, and mugs and cups with one handle."""

from dataclasses import replace

import numpy as np

from schemas.base import Array
from workers.assets.builtin import materials as paint
from workers.assets.builtin.materials import chance, pick
from workers.assets.builtin.parts import Model, Surface
from workers.assets.builtin.solid import Solid, lathe
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
