"""Conversion between depth in metres and depth as it is stored, in 16-bit units along the optical axis."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.images import Images
from workers.geometry.pixels import round_depth


def quantise_depth(depth_m: NDArray[np.floating], images: Images) -> NDArray[np.uint16]:
    """[H, W] uint16: z to the nearest unit; 0 where nothing was hit or z is outside the open range that is stored."""
    low, high = images.depth_range_m
    return round_depth(depth_m, low, high, images.depth_units_per_m)


def dequantise_depth(depth: NDArray[np.uint16], images: Images) -> Array:
    """[H, W] float64 metres, 0 where there is none: what a reader of the stored image gets."""
    return depth / images.depth_units_per_m
