"""Lights and background of a scene: what only RGB depends on."""

from dataclasses import dataclass

from schemas.base import Array


@dataclass(frozen=True, eq=False)
class Light:
    """A distant light: `direction` [3] unit, from the surface towards the light, world; `color` linear RGB radiance."""

    direction: Array
    color: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Appearance:
    """Lights and background; linear RGB radiance. The floor's surface is part of its shape.

    `ambient` comes from all directions in the flat tier; in the raster tier it comes from above, and `below` from below.
    The first light is the key light: it casts shadows in the raster tier.
    """

    ambient: tuple[float, float, float]
    lights: tuple[Light, ...]
    background: tuple[float, float, float]
    """Linear RGB where nothing is hit."""
    below: tuple[float, float, float] = (0.0, 0.0, 0.0)
