"""Median and percentiles, to numpy's bits."""

import numpy as np
import pytest

from workers.geometry.ranks import median, percentile


@pytest.mark.parametrize("numbers", [1, 2, 3, 4, 50, 51, 1000])
def test_the_median_is_numpys(numbers):
    rng = np.random.default_rng(numbers)
    for _ in range(100):
        values = rng.integers(1, 65536, numbers) / 5000.0 if numbers % 2 else rng.normal(size=numbers)
        assert median(values) == np.median(values)


@pytest.mark.parametrize("percent", [0.0, 2.0, 5.0, 33.3, 50.0, 97.5, 100.0])
@pytest.mark.parametrize("numbers", [1, 2, 3, 50, 51, 1000])
def test_a_percentile_is_numpys(numbers, percent):
    rng = np.random.default_rng(numbers)
    for units in (5000.0, 1000.0, 4999.3):
        for _ in range(30):
            values = rng.integers(1, 65536, numbers) / units
            assert percentile(values, percent) == np.percentile(values, percent)


def test_between_two_numbers_a_percentile_is_their_share_of_the_way_and_the_order_does_not_matter():
    assert percentile(np.array([3.0, 1.0]), 25.0) == 1.5
    assert percentile(np.array([1.0, 3.0]), 75.0) == 2.5
    assert median(np.array([7.0, 1.0, 3.0])) == 3.0
    assert median(np.array([7.0, 1.0, 3.0, 4.0])) == 3.5
