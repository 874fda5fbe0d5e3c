"""Lens distortion, exposure, shot noise and read noise of an RGB camera, in linear light. Pure.

8-bit sRGB is decoded by table and encoded by comparison with the 255 limits between codes, so that no machine's power
function decides a rounding.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.job.sensor import Distortion, Exposure, RgbNoise, SensorEffects
from schemas.scene.camera import Intrinsics
from workers.geometry.colour import decode_codes, encode_codes
from workers.geometry.distortion import undistort


def sense_rgb(
    rgb: NDArray[np.uint8],
    intrinsics: Intrinsics,
    effects: SensorEffects,
    exposure_rng: np.random.Generator,
    noise_rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """[H, W, 3] uint8: the stored image of an exact one; the same array where no effect on RGB is on."""
    if not effects.changes_rgb:
        return rgb
    light = decode_codes(rgb)
    if effects.distortion is not None:
        light = distort(light, effects.distortion, intrinsics)
    if effects.exposure is not None:
        light = expose(light, effects.exposure, exposure_rng)
    if effects.rgb_noise is not None:
        light = add_noise(light, effects.rgb_noise, noise_rng)
    return encode_codes(light)


def distort(light: Array, lens: Distortion, k: Intrinsics) -> Array:
    """[H, W, 3] linear light through the lens, interpolated bilinearly; black where the pinhole image ends."""
    u, v = lens_map(lens, k)
    inside = (u >= 0.0) & (u < k.width) & (v >= 0.0) & (v < k.height)
    x = np.clip(np.where(inside, u, 0.5) - 0.5, 0.0, k.width - 1.0)
    y = np.clip(np.where(inside, v, 0.5) - 0.5, 0.0, k.height - 1.0)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, bottom = np.minimum(left + 1, k.width - 1), np.minimum(top + 1, k.height - 1)
    a, b = (x - left)[..., None], (y - top)[..., None]
    upper = light[top, left] * (1.0 - a) + light[top, right] * a
    lower = light[bottom, left] * (1.0 - a) + light[bottom, right] * a
    return np.where(inside[..., None], upper * (1.0 - b) + lower * b, 0.0)


@lru_cache(maxsize=4)
def lens_map(lens: Distortion, k: Intrinsics) -> tuple[Array, Array]:
    """(u, v), each [H, W], read-only: pinhole pixel coordinates of each stored pixel's centre.

    Cached, because it is the same for every view of a job and takes longer than a rendering.
    """
    rows, columns = np.mgrid[0 : k.height, 0 : k.width]
    u, v = undistort(columns + 0.5, rows + 0.5, lens, k)
    return frozen_array(u), frozen_array(v)


def expose(light: Array, exposure: Exposure, rng: np.random.Generator) -> Array:
    """Linear light times 2 to the power of the drawn stops, clipped at white: one gain for the whole image."""
    stops = rng.uniform(exposure.stops.low, exposure.stops.high)
    return np.minimum(light * 2.0**stops, 1.0)


def add_noise(light: Array, noise: RgbNoise, rng: np.random.Generator) -> Array:
    """Linear light with normal noise of variance light / full_well + (read / full_well)^2: shot noise and read noise.

    Photon counts are Poisson distributed (EMVA standard 1288), and nearly normal for thousands of photons.
    """
    variance = light / noise.full_well_e + (noise.read_noise_e / noise.full_well_e) ** 2
    return light + np.sqrt(variance) * rng.standard_normal(light.shape)
