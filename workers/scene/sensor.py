"""Effects of real sensors on depth and colour; masks and labels stay exact. Pure: one generator state gives one image.

Depth: a pixel at an edge may measure a neighbour, or both surfaces at once; the measurement has a systematic and a
random error; some pixels have no depth. `schemas/job/views.py` names the sources of the preset's numbers. Colour, in
linear light: lens distortion, exposure, shot noise and read noise.

8-bit sRGB is decoded by table and encoded by comparison with the 255 limits between codes, so that no machine's power
function decides a rounding.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.job.views import DepthNoise, Distortion, Exposure, Images, RgbNoise, SensorEffects
from schemas.scene.scene import EffectPlan
from schemas.scene.view import Camera, Intrinsics, View
from workers.geometry.colour import decode_codes, encode_codes
from workers.geometry.pixels import dequantise_depth, facing_cosine, quantise_depth, undistort

EDGE_STEP_M = 0.03
"""Smallest second difference of 1/depth, times depth squared, that counts as an edge [assumed]."""


def sense_depth(
    depth_m: Array, region: NDArray[np.uint8], camera: Camera, noise: DepthNoise, rng: np.random.Generator
) -> Array:
    """[H, W] float64 metres: measured depth of exact depth [H, W]; 0, which stands for none, stays 0.

    Every random number is drawn for every pixel, whatever is on, so that no setting changes the numbers of another.
    """
    shape = depth_m.shape
    shift = rng.standard_normal((2, *shape))
    error = rng.standard_normal(shape)
    flies, weight, drops = rng.random((3, *shape))
    edge = near_edge(depth_m, noise)
    # Differences across an edge within one region are no surface's slope.
    cosine = np.where(edge, 1.0, incidence_cosine(depth_m, region, camera))
    z = np.where(edge, shift_lookup(depth_m, shift * noise.lateral_px, noise.edge_px), depth_m)
    near, far = surfaces_around(depth_m, noise.edge_px)
    z = np.where(edge & (flies < noise.flying_share), weight * near + (1.0 - weight) * far, z)
    z = z * (1.0 + noise.offset_share) + noise.offset_m + axial_sigma(z, cosine, noise) * error
    lost = (depth_m <= 0.0) | (cosine < math.cos(math.radians(noise.grazing_deg)))
    lost |= edge & (drops < noise.edge_dropout)
    lost |= (z <= noise.range_m.low) | (z >= noise.range_m.high)
    return np.where(lost, 0.0, z)


def axial_sigma(z: Array, cosine: Array, noise: DepthNoise) -> Array:
    """Standard deviation along the optical axis, metres: (axial_m + axial_per_m z^2) / cos of the angle of incidence.

    The angle of incidence is limited to `grazing_deg`, beyond which nothing is measured.
    """
    steepest = max(math.cos(math.radians(noise.grazing_deg)), 1e-3)
    return (noise.axial_m + noise.axial_per_m * z * z) / np.maximum(cosine, steepest)


def incidence_cosine(depth_m: Array, region: NDArray[np.uint8], camera: Camera) -> Array:
    """[H, W] cosine between the surface's normal and the direction to the camera.

    It is unknown, and set to 1, along the borders of regions and of the image, a pixel wide.
    """
    everywhere = np.arange(depth_m.size)
    cosine = facing_cosine(depth_m, region, everywhere, camera, camera.position).reshape(depth_m.shape)
    return np.where(np.isnan(cosine), 1.0, np.clip(cosine, 0.0, 1.0))


def near_edge(depth_m: Array, noise: DepthNoise) -> NDArray[np.bool_]:
    """[H, W] bool: pixels at most `edge_px` from the far side of a depth edge.

    On every plane 1/z is linear in the image. At an edge its second difference, times z squared, exceeds `EDGE_STEP_M`: a
    floor seen at a flat angle has none. Pixels without depth make no edge.
    """
    edge = np.zeros(depth_m.shape, bool)
    known = depth_m > 0.0
    inverse = 1.0 / np.where(known, depth_m, 1.0)
    along_rows, down_columns = (edge.T, known.T, inverse.T, depth_m.T), (edge, known, inverse, depth_m)
    for marked, has, inv, z in (down_columns, along_rows):
        bend = inv[:-2] + inv[2:] - 2.0 * inv[1:-1]
        marked[1:-1] |= has[:-2] & has[2:] & has[1:-1] & (np.abs(bend) * z[1:-1] ** 2 > EDGE_STEP_M)
    side = 2 * (noise.edge_px - 1) + 1
    grown: NDArray = cv2.dilate(edge.astype(np.uint8), np.ones((side, side), np.uint8))
    return grown.astype(bool) & known


def surfaces_around(depth_m: Array, reach_px: int) -> tuple[Array, Array]:
    """Nearest and farthest depth [H, W] within `reach_px` pixels along rows and columns, of pixels with depth."""
    kernel = np.ones((2 * reach_px + 1,) * 2, np.uint8)
    near = cv2.erode(np.where(depth_m > 0.0, depth_m, np.inf), kernel, borderType=cv2.BORDER_REPLICATE)
    far = cv2.dilate(depth_m, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.where(np.isinf(near), 0.0, near), np.asarray(far)


def shift_lookup(depth_m: Array, shift_px: Array, reach_px: int) -> Array:
    """[H, W]: depth of the pixel `shift_px` [2, H, W] (down, right) away, rounded, within reach, if that has depth.

    It acts at edges alone: within a surface the axial error, measured on surfaces, includes the effect of a shift.
    """
    height, width = depth_m.shape
    down, right = np.clip(np.rint(shift_px), -reach_px, reach_px).astype(np.int64)
    rows = np.clip(np.arange(height)[:, None] + down, 0, height - 1)
    columns = np.clip(np.arange(width)[None, :] + right, 0, width - 1)
    seen: Array = depth_m[rows, columns]
    return np.where(seen > 0.0, seen, depth_m)


Generators = Callable[[str], np.random.Generator]
"""The generator of a sensor effect by its name: one each, so that no other view or effect changes its numbers."""


def sense_rgb(
    rgb: NDArray[np.uint8], intrinsics: Intrinsics, effects: SensorEffects, generator: Generators
) -> NDArray[np.uint8]:
    """[H, W, 3] uint8: the stored image of an exact one; the same array where no effect on RGB is on."""
    if not effects.changes_rgb:
        return rgb
    light = decode_codes(rgb)
    for name, change in RGB_EFFECTS.items():
        if (setting := getattr(effects, name)) is not None:
            light = change(light, setting, intrinsics, generator(name))
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


RGB_EFFECTS: Mapping[str, Callable[[Array, Any, Intrinsics, np.random.Generator], Array]] = {
    "distortion": lambda light, lens, k, _: distort(light, lens, k),
    "exposure": lambda light, exposure, _, rng: expose(light, exposure, rng),
    "rgb_noise": lambda light, noise, _, rng: add_noise(light, noise, rng),
}
"""By its key of `sensor`, what an effect makes of linear light [H, W, 3], in the order in which light meets them.

A new effect on RGB is a row here and its key in schemas/job/views.py: its plan, receipt, chance and time follow from the key.
"""


def sense_view(sensor: SensorEffects, images: Images, view: View, generator: Generators, effects: EffectPlan) -> View:
    """An exact view as its sensors store it; the same view where the plan runs no sensor effect."""
    assert view.region is not None
    withdrawn = [name for name in SensorEffects.model_fields if not effects.runs(f"sensor_{name}")]
    rgb, depth, sensor = view.rgb, view.depth, sensor.model_copy(update=dict.fromkeys(withdrawn))
    if rgb is not None:
        rgb = sense_rgb(rgb, view.camera.intrinsics, sensor, generator)
    if sensor.depth_noise is not None:
        exact_m = dequantise_depth(depth, images)
        rng = generator("depth_noise")
        depth = quantise_depth(sense_depth(exact_m, view.region, view.camera, sensor.depth_noise, rng), images)
    return view if rgb is view.rgb and depth is view.depth else replace(view, rgb=rgb, depth=depth)
