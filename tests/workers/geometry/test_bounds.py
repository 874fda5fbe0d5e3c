"""Bounding boxes of points, against numpy."""

import numpy as np
import pytest

from workers.geometry.mesh import bounds_of


@pytest.mark.parametrize("count", [1, 2, 1000])
@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_corners_are_the_least_and_greatest_coordinates(count, axes, dtype):
    points = np.random.default_rng(count).normal(-2.0, 3.0, (count, 2 * axes)).astype(dtype)[:, ::2]
    low, high = bounds_of(points)
    assert np.array_equal(low, points.min(axis=0)) and np.array_equal(high, points.max(axis=0))
    assert low.dtype == np.float64
