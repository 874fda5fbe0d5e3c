"""Pure: other colours for built-in objects, by one function of hue, saturation and value; greys stay as they are.

Each range of hue takes the hues that are nearest to it, pressed together in their order, so that a shape's colours stay apart.
"""

import functools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.job.look import Palette, Recolour
from schemas.scene.shape import Asset, Material, Part, Shape
from workers.geometry.jit import compiled, compiled_for

PACKAGING = (
    (0.965, 1.03, 0.3, 0.86, 1.05),
    (1.055, 1.145, 0.3, 0.84, 1.25),
    (0.345, 0.405, 0.25, 0.72, 0.72),
    (0.565, 0.655, 0.25, 0.76, 0.86),
)
"""What inks and moulded plastics of packages have, a row a range: first and last hue in turns, saturation that stays, greatest
saturation, and factor of the value of a saturated colour: reds, orange to yellow with kraft, deep greens, blues."""

SLOTS = 4096
"""Colours of a texture that are remembered: most have fewer than a hundred."""


def recoloured(asset: Asset, recolour: Recolour) -> Asset:
    """The asset with the colours of its materials and textures changed; geometry, mass, names and digest stay."""
    rows = palette_rows(recolour)
    if rows is None:
        return asset
    textures: dict[int, NDArray[np.uint8]] = {}  # parts that share a texture go on sharing it
    materials: dict[int, Material] = {}

    def change(part: Part) -> Part:
        material = part.material
        if id(material) not in materials:
            texture = material.texture
            if texture is not None and id(texture) not in textures:
                textures[id(texture)] = recolour_texture(texture, rows)
            red, green, blue, alpha = material.base_color
            red, green, blue = recolour_colour(red, green, blue, rows)
            materials[id(material)] = replace(
                material,
                base_color=(red, green, blue, alpha),
                texture=None if texture is None else textures[id(texture)],
            )
        return replace(part, material=materials[id(material)])

    return replace(asset, shape=Shape(tuple(map(change, asset.shape.parts)), asset.shape.closed))


@functools.lru_cache(maxsize=8)
def palette_rows(recolour: Recolour) -> Array | None:
    """[K, 7]: the hues [begin, end) in turns that go into a range, that range, and the rest of its row; None for as_made.

    Rows ascend from one to the next and cover one turn; between two ranges the middle parts them.
    """
    if recolour == "as_made":
        return None
    if isinstance(recolour, Palette):
        ranges = np.array([(*hue, *recolour.saturation, 1.0) for hue in recolour.hue])
    else:
        ranges = np.array(PACKAGING)
        ranges[2:, :2] += 1.0  # ascending from red
    next_low = np.append(ranges[1:, 0], ranges[0, 0] + 1.0)
    ends = 0.5 * (ranges[:, 1] + next_low)
    return frozen_array(np.column_stack([np.append(ends[-1] - 1.0, ends[:-1]), ends, ranges]))


@compiled
def _into(red: float, green: float, blue: float, rows: Array) -> tuple[float, float, float]:
    """sRGB in [0, 1] by way of hue, saturation and value (Smith 1978)."""
    value, least = max(red, green, blue), min(red, green, blue)
    chroma = value - least
    if chroma <= 0.0:
        return red, green, blue
    if value == red:
        hue = (green - blue) / chroma / 6.0
    elif value == green:
        hue = (2.0 + (blue - red) / chroma) / 6.0
    else:
        hue = (4.0 + (red - green) / chroma) / 6.0
    hue -= np.floor(hue - rows[0, 0])
    row = 0
    while row + 1 < len(rows) and hue >= rows[row, 1]:
        row += 1
    begin, end, low, high, stays, most, factor = rows[row]
    hue = low + (high - low) * (hue - begin) / (end - begin)
    saturation = chroma / value
    value = min(value * (1.0 + (factor - 1.0) * saturation), 1.0)
    if saturation > stays:
        saturation = min(saturation, stays + (most - stays) * (saturation - stays) / (1.0 - stays))
    return (
        _channel(5.0 + 6.0 * hue, saturation, value),
        _channel(3.0 + 6.0 * hue, saturation, value),
        _channel(1.0 + 6.0 * hue, saturation, value),
    )


@compiled
def _channel(sixths: float, saturation: float, value: float) -> float:
    """A channel by its place on the hue's circle, in sixths of a turn."""
    at = sixths - 6.0 * np.floor(sixths / 6.0)
    return value * (1.0 - saturation * max(0.0, min(at, 4.0 - at, 1.0)))


@compiled_for("f8, f8, f8, const(f8[:,::1])")
def recolour_colour(red: float, green: float, blue: float, rows: Array) -> tuple[float, float, float]:
    """One sRGB colour, each in [0, 1]."""
    return _into(red, green, blue, rows)


def recolour_texture(texture: NDArray[np.uint8], rows: Array) -> NDArray[np.uint8]:
    """[h, w, 3 or 4] uint8, read-only: the texture in other colours; its alpha stays."""
    changed = np.array(texture)
    _recolour_texels(changed.reshape(-1, texture.shape[2]), rows)
    changed.setflags(write=False)
    return changed


@compiled_for("u1[:,::1], const(f8[:,::1])")
def _recolour_texels(texels: NDArray[np.uint8], rows: Array) -> None:
    """Changes texels [N, 3 or 4] in place; a colour that was met lately is not computed again."""
    met, into = np.full(SLOTS, -1), np.empty((SLOTS, 3), np.uint8)
    for n in range(len(texels)):
        red, green, blue = np.int64(texels[n, 0]), np.int64(texels[n, 1]), np.int64(texels[n, 2])
        code = (red << 16) | (green << 8) | blue
        slot = ((code * 40503) >> 8) & (SLOTS - 1)
        if met[slot] != code:
            met[slot] = code
            changed = _into(red / 255.0, green / 255.0, blue / 255.0, rows)
            for channel in range(3):
                into[slot, channel] = np.uint8(np.rint(255.0 * changed[channel]))
        for channel in range(3):
            texels[n, channel] = into[slot, channel]
