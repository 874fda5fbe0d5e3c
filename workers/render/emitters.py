"""The lights of tier `pathtraced`, as descriptions of Mitsuba's emitters.

**The key light**, and each light with a size, is `LAMPS` distant lights spread evenly over its disc, with the direction and
strength of the raster tier's. Their shadows are as soft as a disc's, and no path can hit them: a disc a thousand times as bright
as the sky, hit after a mirror, leaves fireflies that hundreds of samples do not average out. Mirrors show a glow in the sky
instead, which has the share `GLOW` of the light.

**The environment map** holds the sky, the other lights as soft lamps, and the light from below the horizon; or it is the
surround's map, with its sun: at 16 paths, errors on a scene under a clear sky are 0.09 rms of the light, 0.07 with the sun as
lamps, and in both no more than 2 pixels in 10,000 are 1.6 times too bright.

**The window of a room** is a rectangle that emits, close before its pane, and is sampled at every bounce. `hide_emitters` hides
it from the camera with the sky, as alpha needs. So the pane is a mirror, and shows a second rectangle, as bright, that faces it.
"""

import math
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.shape import LAMP_RAD, Appearance, Light, Part, Surround
from workers.geometry.colour import decode_srgb
from workers.geometry.frames import UP, pose, rotation_about
from workers.geometry.irradiance import polynomials

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
    """Mitsuba's emitters by name. Each light with a disc has as many of the light samples as the environment map."""
    glow = GLOW if appearance.surround is None else 0.0
    discs = [light for n, light in enumerate(appearance.lights) if has_disc(light, n)]
    lamps = [lamp for light in discs for lamp in _lamps(light, 1.0 - glow)]
    return {f"key-{n}": lamp for n, lamp in enumerate(lamps)} | {"sky": _environment(mi, appearance, len(lamps))}


def has_disc(light: Light, number: int) -> bool:
    """Whether a light is drawn as a disc: the key light is, and those that have a size; what a surround has is in its map."""
    return not light.of_surround and (number == 0 or light.size_rad is not None)


def _lamps(light: Light, share: float) -> list[dict[str, Any]]:
    """Distant lights. One of `color` gives a surface that faces it an irradiance of pi times `color`."""
    irradiance = [math.pi * share * c / LAMPS for c in light.color]
    shine: dict[str, Any] = {"type": "directional", "irradiance": {"type": "rgb", "value": irradiance}}
    spread = lamp_directions(light.direction, LAMP_RAD if light.size_rad is None else light.size_rad)
    return [shine | {"direction": (-towards).tolist()} for towards in spread]


def lamp_directions(direction: Array, size_rad: float = LAMP_RAD) -> Array:
    """[LAMPS, 3] unit: spread evenly over a disc of this angle around a direction, in a spiral (Vogel 1979)."""
    x = np.cross([0.0, 1.0, 0.0] if abs(direction[1]) < 0.9 else [1.0, 0.0, 0.0], direction)
    x /= np.linalg.norm(x)
    y = np.cross(direction, x)
    number = np.arange(LAMPS)
    radius = math.tan(0.5 * size_rad) * np.sqrt((number + 0.5) / LAMPS)
    turn = number * math.pi * (3.0 - math.sqrt(5.0))
    spread = direction + (radius * np.cos(turn))[:, None] * x + (radius * np.sin(turn))[:, None] * y
    return np.asarray(spread / np.linalg.norm(spread, axis=1, keepdims=True), np.float64)


def level_light(appearance: Appearance) -> Array:
    """[3] linear radiance of a level white surface that nothing shades."""
    around = np.array(appearance.ambient)
    if appearance.surround is not None:
        around = polynomials(UP[None])[0] @ appearance.surround.terms
    lit = (max(light.direction[2], 0.0) * np.array(light.color) for light in appearance.lights)
    return np.asarray(sum(lit, around), np.float64)


WINDOW_TIMES = 3.0
"""Radiance of a window by its material's `emission`, which tiers without paths draw as nearly the brightest there is.

In the middle of drawn rooms a side that faces the window has 1.2 times as much light from it as from the key light in the median
(0.4 to 3.5 in nine of ten), and a level surface a tenth of all light (0.04 to 0.19).
"""

WINDOW_LIFT_M = 0.01
"""Of a window's lamp before its pane: less than its frame, and half of it more than the 3 mm that Mitsuba's rays skip at 30 m."""


def rgb_of(color: NDArray) -> dict[str, Any]:
    """A colour [3] as Mitsuba takes it."""
    return {"type": "rgb", "value": [float(c) for c in color]}


def window_of(mi: ModuleType, part: Part, T_world_shape: Pose, light: Array, sampling_weight: float) -> dict[str, Any]:
    """The lamps of a pane, a thin upright box whose inner side faces its shape's origin. `light` [3] as of `level_light`."""
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    axis = int(half.argmin())
    inward = -math.copysign(1.0, middle[axis]) * np.eye(3)[axis]
    color = WINDOW_TIMES * part.material.emission * decode_srgb(np.array(part.material.base_color[:3]))
    lamps = {}
    for name, facing, lift_m, weight in (
        ("lamp", 1, WINDOW_LIFT_M, sampling_weight),
        ("back", -1, WINDOW_LIFT_M / 2, 0.0),
    ):
        across, normal = facing * half[1 - axis] * np.cross(UP, inward), facing * inward
        T = pose(np.stack([across, half[2] * UP, normal], axis=1), middle + (half[axis] + lift_m) * inward)
        shine = {"type": "area", "radiance": rgb_of(color * light), "sampling_weight": weight}
        to_world = mi.ScalarTransform4f(T_world_shape @ T)
        lamps[f"window-{name}"] = {"type": "rectangle", "to_world": to_world, "emitter": shine}
    return lamps


def _environment(mi: ModuleType, appearance: Appearance, lamps: int) -> dict[str, Any]:
    # Mitsuba's map has y up and -z at its left edge; ours has z up and -x there.
    turn = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    if appearance.surround is None:
        picture = sky_picture(appearance, sky_directions(np.arange(SKY_PX[1]) / (SKY_PX[1] - 1.0)))
    else:
        picture = _from_pole_to_pole(appearance.surround)
        turn = pose(rotation_about(UP, appearance.surround.turn_rad), np.zeros(3)) @ turn
    around = {"type": "envmap", "bitmap": mi.Bitmap(picture.astype(np.float32)), "to_world": mi.ScalarTransform4f(turn)}
    return around | {"sampling_weight": float(LAMPS) if lamps else 1.0}


def _from_pole_to_pole(surround: Surround) -> Array:
    """[H + 1, 2 H, 3]: the map, with its first row the zenith itself and its last the nadir, as Mitsuba has it."""
    rows = surround.scale * surround.radiance.astype(np.float64)
    return np.concatenate([rows[:1], 0.5 * (rows[:-1] + rows[1:]), rows[-1:]])


def sky_picture(appearance: Appearance, directions: Array) -> Array:
    """[H, W, 3] linear radiance from directions [H, W, 3] in even steps over the whole sphere."""
    sine = directions[..., 2:]
    sky = np.array(appearance.ambient) * (HORIZON + (ZENITH - HORIZON) * sine)
    picture = np.where(sine > 0.0, sky, np.array(appearance.below))
    level = np.sqrt(1.0 - sine**2)
    cell_sr = level * (4.0 * math.pi / level.sum())
    for number, light in enumerate(appearance.lights):
        share, width = (GLOW, GLOW_RAD) if has_disc(light, number) else (1.0, FILL_RAD)
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
