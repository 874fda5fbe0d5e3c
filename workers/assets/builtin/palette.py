"""Pure: random draws from a numpy generator: choices, chances, and colours of everyday objects, sRGB."""

import colorsys
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Choice = TypeVar("Choice")
Color = tuple[float, float, float]
"""sRGB, each in [0, 1]."""

WHITE: Color = (0.93, 0.92, 0.89)
BLACK: Color = (0.07, 0.07, 0.075)
_GLASSES: tuple[Color, ...] = (
    (0.09, 0.2, 0.09),
    (0.13, 0.26, 0.12),
    (0.3, 0.16, 0.05),
    (0.2, 0.1, 0.04),
    (0.62, 0.74, 0.7),
    (0.7, 0.8, 0.82),
    (0.1, 0.17, 0.36),
)
_GLAZES: tuple[Color, ...] = (
    (0.94, 0.93, 0.9),
    (0.9, 0.86, 0.77),
    (0.15, 0.2, 0.32),
    (0.2, 0.32, 0.27),
    (0.62, 0.33, 0.22),
    (0.76, 0.6, 0.25),
    (0.36, 0.5, 0.56),
    (0.55, 0.57, 0.55),
    (0.82, 0.66, 0.64),
    (0.1, 0.1, 0.11),
    (0.66, 0.73, 0.66),
    (0.55, 0.16, 0.15),
)
_WOODS: tuple[tuple[Color, Color], ...] = (
    ((0.76, 0.6, 0.42), (0.62, 0.45, 0.28)),
    ((0.55, 0.38, 0.24), (0.4, 0.26, 0.15)),
    ((0.36, 0.23, 0.15), (0.24, 0.14, 0.09)),
    ((0.84, 0.73, 0.57), (0.73, 0.6, 0.43)),
    ((0.66, 0.44, 0.28), (0.5, 0.3, 0.17)),
    ((0.5, 0.46, 0.41), (0.38, 0.34, 0.3)),
)


def pick(rng: np.random.Generator, choices: Sequence[Choice]) -> Choice:
    """One of the choices, each as likely as the next."""
    return choices[int(rng.integers(len(choices)))]


def chance(rng: np.random.Generator, share: float) -> bool:
    """True with this probability."""
    return bool(rng.random() < share)


def hsv(h: float, s: float, v: float) -> Color:
    """sRGB of a hue (in turns), saturation and value."""
    return colorsys.hsv_to_rgb(h % 1.0, min(max(s, 0.0), 1.0), min(max(v, 0.0), 1.0))


def vivid(rng: np.random.Generator) -> Color:
    """A printed or moulded colour."""
    return hsv(rng.random(), rng.uniform(0.45, 0.9), rng.uniform(0.4, 0.85))


def pale(rng: np.random.Generator) -> Color:
    """A light, faint colour."""
    return hsv(rng.random(), rng.uniform(0.04, 0.25), rng.uniform(0.82, 0.95))


def jitter(rng: np.random.Generator, color: Color, by: float = 0.04) -> Color:
    """The colour, each channel and the lightness varied by up to `by`."""
    shift = rng.uniform(-by, by, 4)
    r, g, b = (float(min(max(c + shift[3] + 0.5 * d, 0.02), 0.98)) for c, d in zip(color, shift[:3], strict=True))
    return (r, g, b)


def mix(a: Color, b: Color, share: float) -> Color:
    """Colour a blended with `share` of b."""
    r, g, bl = (x + share * (y - x) for x, y in zip(a, b, strict=True))
    return (r, g, bl)


def lightness(color: Color) -> float:
    """Rec. 709 luma of an sRGB colour."""
    return 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2]


def ink_on(rng: np.random.Generator, paper: Color) -> Color:
    """A colour that can be read on the paper."""
    dark = lightness(paper) > 0.45
    if chance(rng, 0.4):
        return BLACK if dark else WHITE
    return hsv(rng.random(), rng.uniform(0.4, 0.95), rng.uniform(0.15, 0.4) if dark else rng.uniform(0.85, 1.0))


def glaze_color(rng: np.random.Generator) -> Color:
    """A colour of glazed pottery."""
    return jitter(rng, pick(rng, _GLAZES), 0.05) if chance(rng, 0.8) else vivid(rng)


def glass_color(rng: np.random.Generator) -> Color:
    """A colour of bottle glass as an opaque body."""
    return jitter(rng, pick(rng, _GLASSES), 0.03)


def wood_colors(rng: np.random.Generator) -> tuple[Color, Color]:
    """The light and the dark colour of a wood."""
    light, dark = pick(rng, _WOODS)
    shift = rng.uniform(-0.05, 0.05)
    towards = WHITE if shift > 0 else BLACK
    return mix(light, towards, abs(shift)), mix(dark, towards, abs(shift))
