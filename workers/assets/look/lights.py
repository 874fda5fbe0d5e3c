"""The light that a job's `look` asks for, as it is drawn for a scene: lights from ranges, and which map of light."""

import math
from dataclasses import dataclass

import numpy as np

from schemas.base import Array, Range, frozen_array
from schemas.job.look import BUILT_IN, Environment, Lights
from schemas.scene.shape import Light, MapSource
from workers.assets.builtin.materials import Color
from workers.assets.look.appearance import ALBEDO_IN_LIGHT
from workers.geometry.irradiance import LUMINANCE


@dataclass(frozen=True, eq=False)
class DrawnLights:
    """Lights, and what goes with them: `ambient` from above and `below` from below, linear RGB.

    temperatures_k: colour temperature of each light; rest: the share of all light that is not theirs, times the total.
    """

    lights: tuple[Light, ...]
    temperatures_k: tuple[float, ...]
    rest: float
    ambient: Color
    below: Color


@dataclass(frozen=True, eq=False)
class DrawnEnvironment:
    """A map, and its turn, counter-clockwise from above."""

    source: MapSource
    turn_rad: float


XYZ_TO_RGB = np.array(
    [[3.2406255, -1.537208, -0.4986286], [-0.9689307, 1.8757561, 0.0415175], [0.0557101, -0.2040211, 1.0569959]]
)
"""Linear sRGB of CIE XYZ (IEC 61966-2-1)."""


def planckian_rgb(kelvin: float) -> Array:
    """[3] linear sRGB of luminance 1 of a black body, 1667 to 25,000 K; what is out of gamut is 0.

    Chromaticity by the cubic splines of Kim et al. 2002 (US patent 7,024,034), within 2e-3 of Planck's law.
    """
    t = 1e3 / kelvin
    low, high = (-0.2661239, -0.234358, 0.8776956, 0.17991), (-3.0258469, 2.1070379, 0.2226347, 0.24039)
    x = float(np.polyval(low if kelvin <= 4000.0 else high, t))
    if kelvin <= 2222.0:
        curve = (-1.1063814, -1.3481102, 2.18555832, -0.20219683)
    elif kelvin <= 4000.0:
        curve = (-0.9549476, -1.37418593, 2.09137015, -0.16748867)
    else:
        curve = (3.081758, -5.8733867, 3.75112997, -0.37001483)
    y = float(np.polyval(curve, x))
    rgb = np.maximum(XYZ_TO_RGB @ [x / y, 1.0, (1.0 - x - y) / y], 0.0)
    return np.asarray(rgb / (rgb @ LUMINANCE), np.float64)


def draw_lights(rng: np.random.Generator, spec: Lights) -> DrawnLights:
    """Lights from the ranges of a job, and the even light from above and below that is the rest."""

    def draw(ends: Range) -> float:
        return float(rng.uniform(ends.low, ends.high))

    count = int(rng.integers(spec.number.low, spec.number.high + 1))
    share, total = draw(spec.share), draw(spec.total) * ALBEDO_IN_LIGHT
    lights, temperatures = list[Light](), list[float]()
    for number in range(count):
        azimuth, elevation, size, kelvin = (
            draw(ends) for ends in (spec.azimuth_deg, spec.elevation_deg, spec.size_deg, spec.temperature_k)
        )
        part = 1.0 if count == 1 else 0.5 if number == 0 else 0.5 / (count - 1)
        a, e = math.radians(azimuth), math.radians(elevation)
        towards = frozen_array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
        color = planckian_rgb(kelvin) * (part * share * total / math.sin(e))
        lights.append(Light(towards, rgb(color), math.radians(size)))
        temperatures.append(kelvin)
    rest = (1.0 - share) * total
    below = rest * rng.uniform(0.45, 0.7)
    return DrawnLights(tuple(lights), tuple(temperatures), rest / ALBEDO_IN_LIGHT, (rest,) * 3, (below,) * 3)


def describe_lights(drawn: DrawnLights) -> list[dict[str, object]]:
    """Lights by the fields of `scenes.surroundings.lights`."""
    return [
        {
            "towards": light.direction.tolist(),
            "level": float(np.dot(light.color, LUMINANCE) * light.direction[2]),
            "temperature_k": kelvin,
            "size_deg": math.degrees(light.size_rad or 0.0),
        }
        for light, kelvin in zip(drawn.lights, drawn.temperatures_k, strict=True)
    ]


def draw_environment(rng: np.random.Generator, spec: Environment, maps: tuple[MapSource, ...]) -> DrawnEnvironment:
    """One of the maps that a job names, and its turn; `maps`: those of its folder."""
    names = spec.built_in or (BUILT_IN if spec.folder is None else ())
    every = (*(MapSource(name) for name in names), *maps)
    source = every[int(rng.integers(len(every)))]
    return DrawnEnvironment(source, math.radians(float(rng.uniform(*spec.turn_deg))))


def rgb(color: Array) -> Color:
    """Three numbers of an array."""
    red, green, blue = color.tolist()
    return red, green, blue
