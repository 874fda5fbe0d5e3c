"""An `Appearance` as Mitsuba's lights: the same directions and strengths as in the raster tier.

The key light is a disc as wide as a lamp of `LAMP_RAD`, far away; the sky, its other lights as soft lamps, and what
comes from below the horizon are one picture around the scene.
"""

import math
from types import ModuleType
from typing import Any

import numpy as np

from schemas.base import Array
from schemas.scene import Appearance, Light
from workers.render.baking import LAMP_RAD

FAR_M = 100.0
"""Of the key light: over a table its direction changes by half a degree."""

SKY_PX = (128, 64)
"""Width and height of the picture around the scene; it holds nothing sharp."""

FILL_RAD = 0.25
"""Standard deviation of a fill light about its direction: a lamp of a metre at two."""

ZENITH, HORIZON = 1.2, 0.6
"""Radiance of the sky straight up and at the horizon, over what lights a level surface as much from everywhere.

It grows with the sine of the elevation: then HORIZON + 2/3 (ZENITH - HORIZON) must be 1.
"""


def lights_of(mi: ModuleType, appearance: Appearance) -> dict[str, Any]:
    """Mitsuba's emitters by name."""
    key = {"key": _disc(mi, appearance.lights[0])} if appearance.lights else {}
    return key | {"sky": _surroundings(mi, appearance)}


def _disc(mi: ModuleType, light: Light) -> dict[str, Any]:
    """Its radiance L makes a surface that faces it as bright as a distant light of `color`: L sin^2(half its angle)."""
    half = 0.5 * LAMP_RAD
    place = mi.ScalarTransform4f().look_at(
        origin=(FAR_M * light.direction).tolist(), target=[0.0, 0.0, 0.0], up=_aside(light.direction)
    )
    radiance = [c / math.sin(half) ** 2 for c in light.color]
    return {
        "type": "disk",
        "to_world": place.scale(FAR_M * math.tan(half)),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    }


def _aside(direction: Array) -> list[float]:
    return [0.0, 1.0, 0.0] if abs(direction[1]) < 0.9 else [1.0, 0.0, 0.0]


def _surroundings(mi: ModuleType, appearance: Appearance) -> dict[str, Any]:
    picture = sky_picture(appearance)
    # Mitsuba's picture has y up and looks along z in its middle; ours z up and x in its middle.
    turn = mi.ScalarTransform4f(np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]))
    return {"type": "envmap", "bitmap": mi.Bitmap(picture.astype(np.float32)), "to_world": turn}


def sky_picture(appearance: Appearance) -> Array:
    """[H, W, 3] linear radiance by direction: row 0 is the zenith, see `sky_directions`."""
    directions = sky_directions()
    sine = directions[..., 2:]
    sky = np.array(appearance.ambient) * (HORIZON + (ZENITH - HORIZON) * sine)
    picture = np.where(sine > 0.0, sky, np.array(appearance.below))
    cosine = np.sqrt(1.0 - sine**2)
    cell_sr = cosine * (2.0 * math.pi / SKY_PX[0]) * (math.pi / SKY_PX[1])
    for light in appearance.lights[1:]:
        towards = directions @ light.direction
        lobe = np.exp((towards - 1.0) / FILL_RAD**2)[..., None]
        lobe = np.where(sine > 0.0, lobe, 0.0)
        received = (lobe * np.maximum(towards, 0.0)[..., None] * cell_sr).sum()
        picture = picture + np.array(light.color) * (math.pi / received) * lobe
    return np.asarray(picture, np.float64)


def sky_directions() -> Array:
    """[H, W, 3] unit, world: where each cell of the picture looks."""
    width, height = SKY_PX
    turn = 2.0 * math.pi * (np.arange(width) + 0.5) / width
    fall = math.pi * (np.arange(height) + 0.5) / height
    directions = np.empty((height, width, 3))
    # x, y, z = z', x', y' of Mitsuba's (sin turn sin fall, cos fall, -cos turn sin fall).
    directions[..., 0] = -np.cos(turn) * np.sin(fall)[:, None]
    directions[..., 1] = np.sin(turn) * np.sin(fall)[:, None]
    directions[..., 2] = np.cos(fall)[:, None]
    return directions
