"""Mitsuba's lights of an `Appearance`: the same directions and strengths as in the raster tier.

**The key light** is `LAMPS` distant lights spread evenly over a lamp of `LAMP_RAD`. Their shadows are as soft as a disc's,
and no path can hit them: a disc a thousand times as bright as the sky, hit after a mirror, leaves fireflies that hundreds of
samples do not average out. Mirrors show a glow in the sky instead, which has the share `GLOW` of the light.

**The environment map** holds the sky, the other lights as soft lamps, and the light from below the horizon.
"""

import math
from types import ModuleType
from typing import Any

import numpy as np

from schemas.base import Array
from schemas.scene.appearance import Appearance, Light
from workers.render.raster.baking import LAMP_RAD

LAMPS = 32
"""Enough to hide their steps: the edge of a table top's shadow on the floor is 4 cm wide, or eight pixels."""

GLOW, GLOW_RAD = 0.04, 0.15
"""Share of the key light that comes from the glow around it, and the glow's standard deviation."""

SKY_PX = (128, 64)
"""Width and height of the environment map; nothing in it is sharp."""

FILL_RAD = 0.25
"""Standard deviation of a fill light about its direction: a lamp of a metre at two."""

ZENITH, HORIZON = 1.2, 0.6
"""Radiance of the sky at the zenith and at the horizon, relative to a uniform sky of the same irradiance from above.

It grows with the sine of the elevation: then HORIZON + 2/3 (ZENITH - HORIZON) must be 1.
"""


def lights_of(mi: ModuleType, appearance: Appearance) -> dict[str, Any]:
    """Mitsuba's emitters by name. Half of the light samples go to the key light, half to the environment map."""
    lamps = _lamps(appearance.lights[0]) if appearance.lights else []
    return {f"key-{n}": lamp for n, lamp in enumerate(lamps)} | {"sky": _environment(mi, appearance)}


def _lamps(light: Light) -> list[dict[str, Any]]:
    """Distant lights. One of `color` gives a surface that faces it an irradiance of pi times `color`."""
    irradiance = [math.pi * (1.0 - GLOW) * c / LAMPS for c in light.color]
    shine: dict[str, Any] = {"type": "directional", "irradiance": {"type": "rgb", "value": irradiance}}
    return [shine | {"direction": (-towards).tolist()} for towards in lamp_directions(light.direction)]


def lamp_directions(direction: Array) -> Array:
    """[LAMPS, 3] unit: spread evenly over a disc of `LAMP_RAD` around a direction, in a spiral (Vogel 1979)."""
    x = np.cross([0.0, 1.0, 0.0] if abs(direction[1]) < 0.9 else [1.0, 0.0, 0.0], direction)
    x /= np.linalg.norm(x)
    y = np.cross(direction, x)
    number = np.arange(LAMPS)
    radius = math.tan(0.5 * LAMP_RAD) * np.sqrt((number + 0.5) / LAMPS)
    turn = number * math.pi * (3.0 - math.sqrt(5.0))
    spread = direction + (radius * np.cos(turn))[:, None] * x + (radius * np.sin(turn))[:, None] * y
    return np.asarray(spread / np.linalg.norm(spread, axis=1, keepdims=True), np.float64)


def _environment(mi: ModuleType, appearance: Appearance) -> dict[str, Any]:
    picture = sky_picture(appearance, sky_directions(np.arange(SKY_PX[1]) / (SKY_PX[1] - 1.0)))
    # Mitsuba's map has y up and -z at its left edge; ours has z up and -x there.
    turn = mi.ScalarTransform4f(np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]))
    around = {"type": "envmap", "bitmap": mi.Bitmap(picture.astype(np.float32)), "to_world": turn}
    return around | {"sampling_weight": float(LAMPS) if appearance.lights else 1.0}


def sky_picture(appearance: Appearance, directions: Array) -> Array:
    """[H, W, 3] linear radiance from directions [H, W, 3] in even steps over the whole sphere."""
    sine = directions[..., 2:]
    sky = np.array(appearance.ambient) * (HORIZON + (ZENITH - HORIZON) * sine)
    picture = np.where(sine > 0.0, sky, np.array(appearance.below))
    level = np.sqrt(1.0 - sine**2)
    cell_sr = level * (4.0 * math.pi / level.sum())
    for number, light in enumerate(appearance.lights):
        share, width = (1.0, FILL_RAD) if number else (GLOW, GLOW_RAD)
        towards = directions @ light.direction
        own_side = (sine > 0.0) == (light.direction[2] > 0.0)
        lobe = np.where(own_side, np.exp((towards - 1.0) / width**2)[..., None], 0.0)
        received = (lobe * np.maximum(towards, 0.0)[..., None] * cell_sr).sum()
        picture = picture + share * np.array(light.color) * (math.pi / received) * lobe
    return np.asarray(picture, np.float64)


def sky_directions(fall: Array) -> Array:
    """[H, W, 3] unit, world: the direction of each cell. `fall` [H]: each row's angle from the zenith, 1 at the nadir.

    Mitsuba's first row is the zenith itself and its last the nadir; columns are centred.
    """
    turn = 2.0 * math.pi * (np.arange(SKY_PX[0]) + 0.5) / SKY_PX[0]
    level, up = np.sin(math.pi * fall)[:, None], np.cos(math.pi * fall)[:, None]
    return np.stack([-np.cos(turn) * level, np.sin(turn) * level, np.broadcast_to(up, (len(fall), len(turn)))], axis=2)
