"""Skies and rooms by formula: equirectangular maps of radiance, as they are seen from a table. No files, and no chance.

Skies follow the CIE's standard general sky (CIE S 011:2003): L = f(angle from the sun) phi(angle from the zenith). Rooms are
boxes: a ray ends on a wall, whose radiance follows from its colour and from how it sees the room's bright patches.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.assets.builtin.materials import Color
from workers.geometry.frames import UP
from workers.geometry.irradiance import LUMINANCE, Map, irradiance, map_directions, reduce_map

HEIGHT = 512
"""Rows of a map."""


def make_sky(name: str) -> Map:
    """[HEIGHT, 2 HEIGHT, 3] float32: the map of a name."""
    look = _LOOKS[name]
    return (
        _draw_sky(look, map_directions(HEIGHT)) if isinstance(look, Sky) else _draw_room(look, map_directions(HEIGHT))
    )


def _smooth(low: float, high: float, x: NDArray) -> NDArray:
    """From 0 to 1 between two values, smoothly."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@dataclass(frozen=True)
class Sky:
    """a to e: the CIE's coefficients; the sun's elevation, its colour, and its share of the light on a level surface."""

    coefficients: tuple[float, float, float, float, float]
    elevation_rad: float
    sun_share: float
    sun: Color
    zenith: Color
    horizon: Color


SUN_RAD = 0.012
"""Radius of the sun's disc: with the brightest of its aureole."""

GROUND_ALBEDO = np.array([0.22, 0.2, 0.17])


def _draw_sky(sky: Sky, directions: Map) -> Map:
    a, b, c, d, e = sky.coefficients
    sine = np.maximum(directions[..., 2], np.float32(0.01))
    sun = np.array([math.cos(sky.elevation_rad), 0.0, math.sin(sky.elevation_rad)], np.float32)
    cosine = np.clip(directions @ sun, -1.0, 1.0)
    away = np.arccos(cosine)
    level = (1.0 + a * np.exp(b / sine)) * (1.0 + c * (np.exp(d * away) - math.exp(d * math.pi / 2)) + e * cosine**2)
    high = np.sqrt(sine)[..., None]
    picture = level[..., None] * (high * np.array(sky.zenith) + (1.0 - high) * np.array(sky.horizon))
    above = directions[..., 2:] > 0.0
    picture = np.where(above, picture, 0.0).astype(np.float32)
    diffuse = irradiance(reduce_map(picture, 64), UP[None])[0]
    disc = 1.0 - _smooth(0.9 * SUN_RAD, 1.1 * SUN_RAD, away)
    # A disc of radiance L at elevation h gives L sin(h) pi r^2 / pi to a level surface.
    strength = sky.sun_share / (1.0 - sky.sun_share) * (diffuse @ LUMINANCE) / (sun[2] * SUN_RAD**2)
    light = diffuse + strength * sun[2] * SUN_RAD**2 * np.array(sky.sun)
    picture += (strength * disc)[..., None] * np.array(sky.sun, np.float32)
    haze = _smooth(0.0, 0.25, -directions[..., 2])[..., None]
    far = picture[len(picture) // 2 - 2].mean(axis=0)  # just above the horizon
    ground = haze * GROUND_ALBEDO * light + (1.0 - haze) * 0.5 * (far + GROUND_ALBEDO * light)
    return np.where(above, picture, ground).astype(np.float32)


@dataclass(frozen=True)
class Patch:
    """A rectangle on a wall: axis and side of that, its bounds along the two other axes, metres, and its radiance."""

    axis: int
    side: int
    low: tuple[float, float]
    high: tuple[float, float]
    radiance: Color
    bars: int = 0
    """Into how many panes frames divide it, both ways."""


@dataclass(frozen=True)
class Room:
    """A box about the origin: its lower and upper corner, colours of walls, floor and ceiling, patches, and light on all."""

    low: Color
    high: Color
    walls: Color
    floor: Color
    ceiling: Color
    patches: Sequence[Patch]
    fill: float


def _draw_room(room: Room, directions: Map) -> Map:
    low, high = np.array(room.low, np.float32), np.array(room.high, np.float32)
    ends = np.where(directions > 0.0, high, low) / np.where(np.abs(directions) < 1e-6, np.float32(1e-6), directions)
    axis = np.argmin(ends, axis=2)
    points = directions * np.min(ends, axis=2)[..., None]
    side = np.take_along_axis(directions, axis[..., None], axis=2)[..., 0] > 0.0
    level = axis == 2
    albedo = np.where(level[..., None], np.where(side[..., None], room.ceiling, room.floor), room.walls)
    skirting = ~level & (points[..., 2] < low[2] + 0.08)
    albedo = np.where(skirting[..., None], 0.55 * albedo, albedo)
    normals = np.where(np.arange(3) == axis[..., None], np.where(side, -1.0, 1.0)[..., None], 0.0).astype(np.float32)
    light = np.full(directions.shape, room.fill, np.float32)
    for patch in room.patches:
        light += _received(patch, room, points, normals)
    corner = np.sort(np.minimum(points - low, high - points), axis=2)[..., 1]
    picture = albedo * light * (0.7 + 0.3 * _smooth(0.0, 0.6, corner))[..., None]
    for patch in room.patches:
        on = (axis == patch.axis) & (side == (patch.side > 0))
        first, second = (a for a in range(3) if a != patch.axis)
        place = np.stack([(points[..., a] - low_a) / (high_a - low_a) for a, low_a, high_a in
                          zip((first, second), patch.low, patch.high, strict=True)], axis=2)  # fmt: skip
        inside = on & ((place > 0.0) & (place < 1.0)).all(axis=2)
        shade = 0.75 + 0.5 * np.clip(place[..., 1:], 0.0, 1.0) if patch.axis < 2 else 1.0
        picture = np.where(inside[..., None], shade * np.array(patch.radiance), picture)
        if patch.bars:
            bar = np.abs(patch.bars * place - np.round(patch.bars * place)).min(axis=2) < 0.03
            picture = np.where((inside & bar)[..., None], 0.8 * light, picture)
    return picture.astype(np.float32)


def _received(patch: Patch, room: Room, points: NDArray, normals: NDArray) -> NDArray:
    """[H, W, 3]: irradiance / pi of points by a patch, as if all of it were in its middle, a little away."""
    middle = np.insert(
        (np.array(patch.low) + patch.high) / 2, patch.axis, (room.low, room.high)[patch.side > 0][patch.axis]
    )
    area, away = float(np.prod(np.array(patch.high) - patch.low)), middle.astype(np.float32) - points
    cosines = np.maximum((normals * away).sum(axis=2), 0.0) * np.maximum(away[..., patch.axis] * patch.side, 0.0)
    share = cosines * area / (np.pi * ((away * away).sum(axis=2) + area / np.pi) ** 2)
    return share[..., None] * np.array(patch.radiance, np.float32)


# Of the CIE's types 12 (clear), 1 (overcast) and 11 (white-blue, with a distinct corona).
_CLEAR, _OVERCAST, _HAZY = (-1.0, -0.32, 10.0, -3.0, 0.45), (4.0, -0.7, 0.0, -1.0, 0.0), (-1.0, -0.55, 10.0, -3.0, 0.45)
_WHITE = (1.0, 1.0, 1.0)
_LAMPS = tuple(
    Patch(2, 1, (x - 0.6, y - 0.15), (x + 0.6, y + 0.15), (11.0, 10.4, 9.4)) for x in (-1.8, 0.6) for y in (-1.5, 0.9)
)

_LOOKS: Mapping[str, Sky | Room] = {
    "clear_sky": Sky(_CLEAR, 0.85, 0.75, (1.0, 0.95, 0.87), (0.32, 0.55, 1.0), (0.85, 0.95, 1.0)),
    "low_sun": Sky(_HAZY, 0.4, 0.65, (1.0, 0.72, 0.45), (0.5, 0.62, 0.95), (1.0, 0.86, 0.72)),
    "overcast": Sky(_OVERCAST, 1.0, 0.0, _WHITE, (0.95, 0.98, 1.02), _WHITE),
    "window_room": Room(
        (-2.6, -2.2, -0.9), (2.0, 2.4, 1.6), (0.72, 0.69, 0.62), (0.34, 0.23, 0.15), (0.82, 0.81, 0.79),
        (Patch(0, 1, (-1.1, -0.1), (0.9, 1.3), (9.2, 9.8, 10.8), 2),
         Patch(1, -1, (-1.9, -0.1), (-0.9, 1.2), (5.0, 5.4, 6.0), 2)), 0.5,
    ),
    "office": Room(
        (-3.5, -2.8, -0.8), (3.0, 2.6, 1.9), (0.75, 0.75, 0.73), (0.28, 0.3, 0.33), (0.8, 0.8, 0.8), _LAMPS, 0.3
    ),
    "softboxes": Room(
        (-2.2, -2.2, -0.8), (2.2, 2.2, 1.9), (0.2, 0.2, 0.21), (0.3, 0.3, 0.3), (0.16, 0.16, 0.16),
        (Patch(2, 1, (-1.0, -0.7), (0.4, 0.7), (7.0, 6.9, 6.7)), Patch(1, 1, (-0.5, -0.2), (0.9, 1.2), (5.0, 5.0, 5.1)),
         Patch(0, -1, (-1.3, -0.5), (-0.9, 1.4), (9.0, 9.2, 9.6))), 0.5,
    ),
}  # fmt: skip
