"""Stored depth against its definition: units to the nearest, 0 outside the stored range."""

import numpy as np

from schemas.job.images import Images
from workers.geometry.stored_depth import dequantise_depth, quantise_depth

IMAGES = Images()


def test_depth_comes_back_to_within_half_a_unit():
    low, high = IMAGES.depth_range_m
    depth = np.random.default_rng(0).uniform(low + 1e-3, high - 1e-3, (20, 30))
    stored = quantise_depth(depth, IMAGES)
    assert stored.dtype == np.uint16
    assert np.abs(dequantise_depth(stored, IMAGES) - depth).max() <= 0.5 / IMAGES.depth_units_per_m + 1e-12


def test_depth_outside_the_range_is_zero():
    low, high = IMAGES.depth_range_m
    assert not quantise_depth(np.array([[0.0, low, high, np.nan, np.inf]]), IMAGES).any()
