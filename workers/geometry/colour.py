"""Colour: sRGB and linear light (IEC 61966-2-1), as numbers from 0 to 1 and as 8-bit codes; holes in textures."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array


def decode_srgb(encoded: Array) -> Array:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def encode_srgb(linear: Array) -> Array:
    """sRGB values in [0, 1] of linear light, which is clipped to [0, 1] (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _to_linear(code: float) -> float:
    """IEC 61966-2-1: linear light, 0 to 1, of an sRGB value on the scale 0 to 255."""
    value = code / 255.0
    return value / 12.92 if value <= 0.04045 else float(((value + 0.055) / 1.055) ** 2.4)


SRGB_STEPS = np.array([_to_linear(code) for code in range(256)])
"""[256] float64: linear light, 0 to 1, of each code."""

LIMITS = np.array([_to_linear(code + 0.5) for code in range(255)])
"""[255] linear light halfway, in sRGB, between a code and the next."""


def decode_codes(rgb: NDArray[np.uint8]) -> Array:
    """Linear light, 0 to 1, float64."""
    light: Array = SRGB_STEPS[rgb]
    return light


def encode_codes(light: Array) -> NDArray[np.uint8]:
    """8-bit sRGB to the nearest; below black is black, above white is white."""
    return np.searchsorted(LIMITS, light).astype(np.uint8)


HOLE_ALPHA = 128
"""Texels of a smaller alpha, of 255, are holes in colour."""


def has_holes(texture: NDArray[np.uint8] | None) -> bool:
    """Whether a texture [h, w, 3 or 4] has holes."""
    return texture is not None and texture.shape[2] == 4 and bool((texture[..., 3] < HOLE_ALPHA).any())


def attribute_colors(values: NDArray | None, count: int, linear: bool = False) -> NDArray[np.uint8] | None:
    """Vertex colours, floats in [0, 1] or integers that use the whole range of their type, as [V, 4] uint8 sRGB.

    `linear`: they are linear, as those of a stored GLB. None where they cannot be used.
    """
    if values is None or np.shape(values) not in ((count, 3), (count, 4)):
        return None
    whole = np.issubdtype(values.dtype, np.integer)
    share = np.ones((count, 4))
    share[:, : values.shape[1]] = values / np.iinfo(values.dtype).max if whole else values
    if not np.isfinite(share).all():
        return None
    share = np.clip(share, 0.0, 1.0)
    if linear:
        share[:, :3] = encode_srgb(share[:, :3])
    return np.round(255.0 * share).astype(np.uint8)
