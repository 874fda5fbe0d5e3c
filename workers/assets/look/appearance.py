"""Draws the appearance of a scene from one stream: the floor's material, the background and the lights.

Floors have a fixed collection of textures, each a square [N, N, 3] uint8 sRGB that repeats. A texture holds shades alone, its
lightest about white: the scene's colour multiplies it (`Material.base_color`), and the scene maps it at its own scale, angle
and offset. So a process makes each texture once and hands the same array to the renderer again.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.job.views import Studio, Tier
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from workers.assets.builtin.materials import Color, Plane, Texture, stretched
from workers.geometry.colour import decode_srgb

FLOOR_HALF_M = 30.0
"""Half the floor's side. The lowest ray of an input camera (0.7 rad less half the field of view) meets the floor some
11 m away, a corner ray at 13 m."""

ALBEDO_IN_LIGHT = 0.95
"""Light on a level white surface in the middle of a scene, from all lights together: just below what clips."""


def draw_appearance(rng: np.random.Generator, tier: Tier) -> tuple[Shape, Appearance]:
    """The floor, and the lights and background, of a scene. The floor's geometry never changes."""
    if tier == "flat":
        return _floor(_plain_material(rng)), _two_lights(rng)
    material, period_m = draw_floor_material(rng)
    return _floor(material, floor_uv(rng, period_m)), _studio(rng)


_CORNERS = frozen_array(
    FLOOR_HALF_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
)
_FACES = frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)


def _floor(material: Material, uv: Array | None = None) -> Shape:
    """A level square at z = 0."""
    return Shape((Part("floor", _CORNERS, _FACES, material, uv=uv),))


def floor_uv(rng: np.random.Generator, period_m: float | Array) -> Array:
    """uv [4, 2] of the floor's corners, at a random angle and offset; `period_m`: of both axes, or [2] along u and v."""
    angle, shift = rng.uniform(-math.pi, math.pi), rng.random(2)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return frozen_array(_CORNERS[:, :2] @ turn.T / period_m + shift)


def _plain_material(rng: np.random.Generator) -> Material:
    """A muted colour."""
    value, warmth = rng.uniform(0.35, 0.75), rng.uniform(-0.08, 0.08)
    return Material(base_color=(value + warmth, value, value - warmth, 1.0), roughness=0.9)


def _two_lights(rng: np.random.Generator) -> Appearance:
    """A key light from above and a weaker fill from the other side."""
    azimuth, elevation = rng.uniform(-math.pi, math.pi), rng.uniform(0.8, 1.3)
    strength = rng.uniform(0.55, 0.8)
    return Appearance(
        ambient=(0.32, 0.33, 0.35),
        lights=(
            Light(_direction(azimuth, elevation), (strength, strength * 0.97, strength * 0.92)),
            Light(_direction(azimuth + 2.4, 0.6), (0.18, 0.19, 0.21)),
        ),
        background=(0.8, 0.85, 0.9),
    )


def _direction(azimuth: float, elevation: float) -> Array:
    level = math.cos(elevation)
    return frozen_array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])


STUDIO_LIGHTS: Mapping[str, Appearance] = {
    "even": Appearance((0.95,) * 3, (Light(_direction(0.0, 0.5), (0.0,) * 3),), (0.0,) * 3, (0.45,) * 3, sheen=0.15),
    "three_point": Appearance(
        (0.25,) * 3,
        (
            Light(_direction(0.8, 0.6), (0.55, 0.54, 0.52)),
            Light(_direction(-0.9, 0.3), (0.22, 0.23, 0.24)),
            Light(_direction(math.pi, 0.9), (0.3,) * 3),
        ),
        (0.0,) * 3,
        below=(0.2,) * 3,
    ),
    "environment": Appearance(
        (0.85, 0.88, 0.92), (Light(_direction(0.0, 0.5), (0.0,) * 3),), (0.0,) * 3, (0.38, 0.36, 0.33), sheen=0.3
    ),
}
"""The light of studio scenes, fixed in the world. Nothing of it casts a shadow."""


def studio_light(studio: Studio) -> Appearance:
    """Light and background of a studio scene; behind a transparent one is black."""
    if studio.background == "transparent":
        return STUDIO_LIGHTS[studio.light]
    red, green, blue = (float(x) for x in decode_srgb(np.rint(255.0 * np.array(studio.background)).astype(np.uint8)))
    return replace(STUDIO_LIGHTS[studio.light], background=(red, green, blue))


def _studio(rng: np.random.Generator) -> Appearance:
    """A key light 40 to 80 degrees above the horizon, up to two fill lights, and a sky and ground of other tints."""
    azimuth, elevation = rng.uniform(-math.pi, math.pi), rng.uniform(0.7, 1.4)
    key_share, warmth, total = rng.uniform(0.5, 0.72), rng.uniform(-0.06, 0.1), rng.uniform(0.8, 1.05)
    fills = int(rng.integers(0, 3))
    level = ALBEDO_IN_LIGHT * total
    key = level * key_share / math.sin(elevation)
    rest = level * (1.0 - key_share)
    lights = [Light(_direction(azimuth, elevation), _tint(key, warmth))]
    for _ in range(fills):
        turned, height = azimuth + rng.uniform(1.2, 5.0), rng.uniform(0.4, 1.2)
        share = rng.uniform(0.1, 0.25)
        lights.append(Light(_direction(turned, height), _tint(rest * share, rng.uniform(-0.1, 0.1))))
    sky = rest * (1.0 - 0.12 * fills)
    return Appearance(
        ambient=_tint(sky, -0.7 * warmth + rng.uniform(-0.03, 0.03)),
        lights=tuple(lights),
        background=_tint(rng.uniform(0.2, 0.9), rng.uniform(-0.1, 0.1)),
        below=_tint(sky * rng.uniform(0.45, 0.7), warmth),
    )


def _tint(level: float, warmth: float) -> tuple[float, float, float]:
    """Linear RGB with this level of green, redder where warmth is positive and bluer where it is negative."""
    return (level * (1.0 + warmth), level, level * (1.0 - 1.5 * warmth))


TEXTURE_PX = 512
PERIOD_M = (2.6, 4.2)
"""After how many metres a pattern repeats: more than a camera of the default orbit sees of the floor nearby."""

_SEED = 48_271
"""Seed of the collection, which is the same in every dataset."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """A texture [N, N, 3] uint8 sRGB, read-only, and the shade that its white stands for."""

    texture: Texture
    white: float


@dataclass(frozen=True)
class FloorKind:
    """One kind of floor: how its shades are drawn, how many patterns the collection has, and its colour and roughness."""

    draw_shades: Callable[[np.random.Generator], Sequence[Plane]]
    patterns: int
    color: Callable[[np.random.Generator], NDArray[np.float64]]
    roughness: tuple[float, float]


def draw_floor_material(rng: np.random.Generator) -> tuple[Material, float]:
    """One of the textures in a colour of its kind, and after how many metres it repeats."""
    number = int(rng.integers(len(FLOOR_KINDS)))
    kind = FLOOR_KINDS[number]
    pattern = make_pattern(number, int(rng.integers(kind.patterns)))
    r, g, b = (float(c) for c in np.clip(pattern.white * kind.color(rng), 0.0, 1.0))
    material = Material((r, g, b, 1.0), roughness=rng.uniform(*kind.roughness), texture=pattern.texture)
    return material, rng.uniform(*PERIOD_M)


@functools.cache  # bounded: `FloorKind.patterns` of each kind, 768 KiB a texture
def make_pattern(kind: int, number: int) -> Pattern:
    """Pattern `number` of a kind of `FLOOR_KINDS`; every call gives the same array."""
    rng = np.random.default_rng(np.random.SeedSequence(_SEED, spawn_key=(kind, number)))
    planes = FLOOR_KINDS[kind].draw_shades(rng)
    white = max(float(plane.max()) for plane in planes)
    shades = [np.rint(plane * np.float32(255.0 / white)).astype(np.uint8) for plane in planes]
    texture = np.asarray(cv2.merge(shades if len(shades) == 3 else shades * 3), np.uint8)
    texture.setflags(write=False)
    return Pattern(texture, white)


def _planks(rng: np.random.Generator) -> Sequence[Plane]:
    """Planes R, G, B of boards of one width in shifted rows, with grain along them, some redder than others."""
    rows, length = int(rng.integers(16, 29)), int(rng.integers(2, 4))
    row, across = _cells(rows)
    shift = rng.random(rows)
    tone = rng.uniform(0.82, 1.1, (rows, length, 1)) * (1.0 + rng.uniform(-0.03, 0.03, (rows, length, 1)) * _WARM)
    at = np.arange(TEXTURE_PX) * length / TEXTURE_PX + shift[:, None]
    whole = at.astype(np.int64)
    boards = [np.take_along_axis(tone[..., c], whole % length, axis=1) for c in range(3)]
    ends = np.where((at - whole) * TEXTURE_PX / length < 1.0, 0.6, 1.0)
    sides = np.where(across * TEXTURE_PX / rows < 1.0, 0.6, 1.0)[:, None]
    gaps = ends.astype(np.float32)[row] * sides.astype(np.float32)
    grain = _noise(rng, 8, 128, 0.06) + _noise(rng, 32, 256, 0.04)
    return [(board.astype(np.float32)[row] + grain) * gaps for board in boards]


def _tiles(rng: np.random.Generator) -> Sequence[Plane]:
    """Square tiles with joints, each of a slightly different shade; some as a checkerboard."""
    count = int(rng.choice([6, 8, 10, 12, 16]))
    cell, at = _cells(count)
    tone = rng.uniform(0.94, 1.04, (count, count)).astype(np.float32)
    if rng.random() < 0.3:
        tone *= np.where((np.arange(count)[:, None] + np.arange(count)) % 2, np.float32(rng.uniform(0.55, 0.8)), 1.0)
    joint = at * np.float32(TEXTURE_PX / count) < 1.5
    shade = tone[cell][:, cell] + _noise(rng, 16, 16, 0.05)
    shade[joint[:, None] | joint] = rng.uniform(0.6, 0.85)
    return [shade]


def _concrete(rng: np.random.Generator) -> Sequence[Plane]:
    """Blotches of several sizes and fine grit."""
    blotch = _noise(rng, 4, 4, 0.03) + _noise(rng, 16, 16, 0.03) + _noise(rng, 64, 64, 0.03)
    return [np.float32(1.0) + blotch + _noise(rng, 256, 256, 0.04)]


def _carpet(rng: np.random.Generator) -> Sequence[Plane]:
    """Fine pile, lighter and darker in worn patches."""
    return [np.float32(1.0) + _noise(rng, 256, 256, 0.08) + _noise(rng, 128, 128, 0.04) + _noise(rng, 8, 8, 0.03)]


def _plain(rng: np.random.Generator) -> Sequence[Plane]:
    """Linoleum or paint: nearly even."""
    return [np.float32(1.0) + _noise(rng, 8, 8, 0.02)]


def _one_of(*colors: Color) -> Callable[[np.random.Generator], NDArray[np.float64]]:
    """Draws one of the colours, varied in lightness and warmth."""
    return lambda rng: (
        np.array(colors[int(rng.integers(len(colors)))])
        * rng.uniform(0.88, 1.12)
        * (1.0 + rng.uniform(-0.06, 0.06) * _WARM)
    )


def _grey(low: float, high: float, warmth: float) -> Callable[[np.random.Generator], NDArray[np.float64]]:
    """Draws a grey from `low` to `high`, redder or bluer by at most `warmth`."""
    return lambda rng: rng.uniform(low, high) + rng.uniform(-warmth, warmth) * _WARM


_WARM = np.array([1.0, 0.0, -1.0])
_WOODS = ((0.66, 0.5, 0.34), (0.5, 0.36, 0.24), (0.74, 0.63, 0.48), (0.36, 0.27, 0.2), (0.62, 0.58, 0.52))
_CLAYS = ((0.78, 0.76, 0.72), (0.6, 0.6, 0.6), (0.66, 0.45, 0.36), (0.82, 0.8, 0.74), (0.42, 0.46, 0.5))

FLOOR_KINDS: Sequence[FloorKind] = (
    FloorKind(_planks, 12, _one_of(*_WOODS), (0.8, 0.9)),
    FloorKind(_tiles, 12, _one_of(*_CLAYS), (0.8, 0.9)),
    FloorKind(_concrete, 6, _grey(0.4, 0.7, 0.03), (0.9, 0.9)),
    FloorKind(_carpet, 6, lambda rng: rng.uniform(0.3, 0.54, 3), (1.0, 1.0)),
    FloorKind(_plain, 4, _grey(0.35, 0.75, 0.08), (0.85, 0.85)),
)


def _cells(count: int) -> tuple[NDArray[np.int64], Plane]:
    """The cell of `count` that each of N pixels lies in, and its place in the cell, in [0, 1)."""
    at = np.arange(TEXTURE_PX) * count / TEXTURE_PX
    cell = at.astype(np.int64)
    return cell, (at - cell).astype(np.float32)


def _noise(rng: np.random.Generator, across: int, down: int, size: float) -> Plane:
    """[N, N] repeating value noise of about +- size, smooth on a lattice of across x down cells (powers of 2)."""
    lattice = (rng.random((across, down), dtype=np.float32) * np.float32(2.0) - np.float32(1.0)) * np.float32(size)
    return stretched(lattice, TEXTURE_PX, TEXTURE_PX, True)
