"""What only colour depends on, drawn from one stream: the floor's surface, the background and the light."""

import math

import numpy as np

from schemas.base import Array, frozen_array
from schemas.job.render import Tier
from schemas.scene.appearance import Appearance, Light
from schemas.scene.shape import Material, Part, Shape
from workers.assets.appearance.floors import draw_covering

FLOOR_HALF_M = 30.0
"""Half the floor's side. The lowest ray of an input camera (0.7 rad less half the field of view) meets the floor some
11 m away, a corner ray at 13 m."""

ALBEDO_IN_LIGHT = 0.95
"""How much light a level white surface gets in the middle of a scene, key and rest together: just within the picture."""


def draw_look(rng: np.random.Generator, tier: Tier) -> tuple[Shape, Appearance]:
    """(the floor, the light and background) of a scene. The floor's geometry is the same whatever is drawn."""
    if tier == "flat":
        return _floor(_plain_material(rng)), _two_lights(rng)
    covering = draw_covering(rng)
    material = Material((*covering.color, 1.0), 0.0, covering.roughness, covering.picture)
    return _floor(material, _laid(rng, covering.period_m)), _studio(rng)


_CORNERS = frozen_array(
    FLOOR_HALF_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
)
_FACES = frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)


def _floor(material: Material, uv: Array | None = None) -> Shape:
    """A level square at z = 0."""
    return Shape((Part("floor", _CORNERS, _FACES, material, uv=uv),))


def _laid(rng: np.random.Generator, period_m: float) -> Array:
    """uv [4, 2] of the floor's corners: its pattern is turned and shifted by chance."""
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


def _studio(rng: np.random.Generator) -> Appearance:
    """A key light from 40 to 80 degrees above the horizon, none to two weak ones, a sky of another tint, a room around."""
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
    """Linear RGB of this level in the middle, redder where warmth is positive and bluer where it is negative."""
    return (level * (1.0 + warmth), level, level * (1.0 - 1.5 * warmth))


def _direction(azimuth: float, elevation: float) -> Array:
    level = math.cos(elevation)
    return frozen_array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
