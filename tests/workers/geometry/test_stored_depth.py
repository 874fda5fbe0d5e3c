"""Stored depth against its definition: units to the nearest, 0 outside the stored range."""

import numpy as np

from schemas.job.views import Images
from workers.geometry.pixels import dequantise_depth, quantise_depth

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


def test_depth_is_rounded_to_the_nearest_unit_and_zero_outside_the_range():
    depth = np.array([[0.0, 0.2, 0.2001, 1.00009, 1.00011, 7.9999, 8.0, 9.0]])
    assert quantise_depth(depth, IMAGES).tolist() == [[0, 0, 1000, 5000, 5001, 40000, 0, 0]]
    assert quantise_depth(depth, IMAGES).dtype == np.uint16


def test_stored_depth_is_off_by_at_most_half_a_unit():
    depth = np.random.default_rng(0).uniform(0.3, 7.9, (50, 50))
    assert np.abs(dequantise_depth(quantise_depth(depth, IMAGES), IMAGES) - depth).max() <= 1e-4 + 1e-12
