"""What a time-of-flight depth camera makes of exact depth. Pure: the same generator state gives the same image.

The steps, in the order in which they act: a pixel at an edge may look past its place, or at both surfaces at once; the
measurement has a systematic and a random error; some pixels give nothing. `schemas/job/sensor.py` says where the numbers of
the preset come from.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.sensor import DepthNoise
from schemas.scene.camera import Camera
from workers.geometry.normals import facing_cosine


def sense_depth(
    depth_m: Array, region: NDArray[np.uint8], camera: Camera, noise: DepthNoise, rng: np.random.Generator
) -> Array:
    """[H, W] float64 metres: exact depth [H, W] (0 for none) as the camera would measure it; what is 0 stays 0.

    Every random number is drawn for every pixel, whatever is switched on, so that one setting never moves another's
    noise.
    """
    shape = depth_m.shape
    shift = rng.standard_normal((2, *shape))
    error = rng.standard_normal(shape)
    flies, weight, drops = rng.random((3, *shape))
    edge = near_edge(depth_m, noise)
    # Differences across an edge within one region are no surface's slope.
    cosine = np.where(edge, 1.0, incidence_cosine(depth_m, region, camera))
    z = np.where(edge, look_aside(depth_m, shift * noise.lateral_px, noise.edge_px), depth_m)
    near, far = surfaces_around(depth_m, noise.edge_px)
    z = np.where(edge & (flies < noise.flying_share), weight * near + (1.0 - weight) * far, z)
    z = z * (1.0 + noise.offset_share) + noise.offset_m + axial_sigma(z, cosine, noise) * error
    lost = (depth_m <= 0.0) | (cosine < math.cos(math.radians(noise.grazing_deg)))
    lost |= edge & (drops < noise.edge_dropout)
    lost |= (z <= noise.range_m.low) | (z >= noise.range_m.high)
    return np.where(lost, 0.0, z)


def axial_sigma(z: Array, cosine: Array, noise: DepthNoise) -> Array:
    """Standard deviation along the optical axis, metres: (axial_m + axial_per_m z^2) / cos^incidence_power.

    No steeper than `grazing_deg`, beyond which nothing is measured.
    """
    steepest = max(math.cos(math.radians(noise.grazing_deg)), 1e-3)
    return (noise.axial_m + noise.axial_per_m * z * z) / np.maximum(cosine, steepest) ** noise.incidence_power


def incidence_cosine(depth_m: Array, region: NDArray[np.uint8], camera: Camera) -> Array:
    """[H, W] cosine between the surface's normal and the direction to the camera; 1 where it is unknown.

    It is unknown along the rims of regions and of the image, a pixel wide.
    """
    everywhere = np.arange(depth_m.size)
    cosine = facing_cosine(depth_m, region, everywhere, camera, camera.position).reshape(depth_m.shape)
    return np.where(np.isnan(cosine), 1.0, np.clip(cosine, 0.0, 1.0))


def near_edge(depth_m: Array, noise: DepthNoise) -> NDArray[np.bool_]:
    """[H, W] bool: pixels at most `edge_px` from the far side of a depth edge.

    As on every plane 1/z is linear in the image, an edge is where its second difference, times z squared, exceeds
    `edge_step_m`: a floor seen at a flat angle has none. Pixels without depth make no edge.
    """
    edge = np.zeros(depth_m.shape, bool)
    known = depth_m > 0.0
    inverse = 1.0 / np.where(known, depth_m, 1.0)
    for axis in (0, 1):
        here, before, after = _triples(axis)
        bend = inverse[before] + inverse[after] - 2.0 * inverse[here]
        all_known = known[before] & known[after] & known[here]
        edge[here] |= all_known & (np.abs(bend) * depth_m[here] ** 2 > noise.edge_step_m)
    side = 2 * (noise.edge_px - 1) + 1
    grown: NDArray = cv2.dilate(edge.astype(np.uint8), np.ones((side, side), np.uint8))
    return grown.astype(bool) & known


def _triples(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...], tuple[slice, ...]]:
    inner, every = slice(1, -1), slice(None)
    if axis == 0:
        return (inner, every), (slice(None, -2), every), (slice(2, None), every)
    return (every, inner), (every, slice(None, -2)), (every, slice(2, None))


def surfaces_around(depth_m: Array, reach_px: int) -> tuple[Array, Array]:
    """Nearest and farthest depth [H, W] within a square of `reach_px` pixels; pixels without depth do not count."""
    kernel = np.ones((2 * reach_px + 1,) * 2, np.uint8)
    near = cv2.erode(np.where(depth_m > 0.0, depth_m, np.inf), kernel, borderType=cv2.BORDER_REPLICATE)
    far = cv2.dilate(depth_m, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.where(np.isinf(near), 0.0, near), np.asarray(far)


def look_aside(depth_m: Array, shift_px: Array, reach_px: int) -> Array:
    """[H, W]: the depth at the pixel that lies `shift_px` [2, H, W] (down, right) away, to the nearest, within reach.

    A pixel that would look at one without depth keeps its own. Within one surface a shift adds nothing that the axial
    error, which is measured on surfaces, does not hold already: it acts at edges alone.
    """
    height, width = depth_m.shape
    down, right = np.clip(np.rint(shift_px), -reach_px, reach_px).astype(np.int64)
    rows = np.clip(np.arange(height)[:, None] + down, 0, height - 1)
    columns = np.clip(np.arange(width)[None, :] + right, 0, width - 1)
    seen: Array = depth_m[rows, columns]
    return np.where(seen > 0.0, seen, depth_m)
