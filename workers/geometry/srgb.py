"""Conversion between sRGB and linear light (IEC 61966-2-1), of numbers in [0, 1] and of 8-bit codes."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array


def decode_srgb(encoded: Array) -> Array:
    """Linear light of sRGB values in [0, 1]."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def encode_srgb(linear: Array) -> Array:
    """sRGB values in [0, 1] of linear light, which is clipped to [0, 1]."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


SRGB_STEPS = decode_srgb(np.arange(256) / 255.0)
"""[256] float64: linear light of each 8-bit code."""

_LIMITS = decode_srgb((2 * np.arange(255) + 1) / 510.0)
"""[255] float64: linear light halfway, in sRGB, between a code and the next."""


def decode_codes(rgb: NDArray[np.uint8]) -> Array:
    """Linear light in [0, 1], float64, of 8-bit codes."""
    light: Array = SRGB_STEPS[rgb]
    return light


def encode_codes(light: Array) -> NDArray[np.uint8]:
    """The nearest 8-bit sRGB code of linear light, which is clipped to [0, 1]."""
    return np.searchsorted(_LIMITS, light).astype(np.uint8)
