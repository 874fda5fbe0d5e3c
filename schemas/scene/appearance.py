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
    """What only RGB depends on, beside the floor's surface, which is in its `Placed` shape; linear RGB radiance.

    `ambient` comes from everywhere in the flat tier, from above in the raster tier, where `below` comes from below. The
    first light is the key light: in the raster tier it throws shadows.
    """

    ambient: tuple[float, float, float]
    lights: tuple[Light, ...]
    background: tuple[float, float, float]
    """Linear RGB where nothing is hit."""
    below: tuple[float, float, float] = (0.0, 0.0, 0.0)
