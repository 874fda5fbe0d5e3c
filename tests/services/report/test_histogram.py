import numpy as np
import pytest

from services.look.charts import FINE, Histogram, Window, window_of


def values_of(seed: int = 3, count: int = 5_000) -> np.ndarray:
    return np.random.default_rng(seed).normal(2.4, 0.2, count)


def test_counts_are_those_of_numpy_whatever_the_batches():
    values = values_of()
    histogram = Histogram(0.0, 9.6)
    for part in np.array_split(values, 7):
        histogram = histogram.add(part)
    expected, _ = np.histogram(values, FINE, (0.0, 9.6))
    assert histogram.counts.tolist() == expected.tolist()
    assert histogram.mean == pytest.approx(values.mean())


def test_percentiles_are_exact_to_a_step():
    values = values_of()
    histogram = Histogram(0.0, 9.6).add(values)
    for share in (0.05, 0.5, 0.95):
        assert histogram.percentile(share) == pytest.approx(np.quantile(values, share), abs=9.6 / FINE)


def test_a_share_of_one_that_most_have_is_told_as_one():
    assert Histogram(0.0, 1.0).add([0.2, 1.0, 1.0, 1.0]).percentile(0.5) == 1.0
    assert Histogram(0.0, 1.0).add([0.25]).percentile(0.5) == 0.25


def test_what_is_unknown_is_left_out_and_what_is_outside_counts_at_the_ends():
    histogram = Histogram(0.0, 1.0).add([np.nan, -5.0, 7.0])
    assert histogram.count == 2
    assert histogram.counts[[0, -1]].tolist() == [1, 1]
    assert np.isnan(Histogram(0.0, 1.0).percentile(0.5)) and np.isnan(Histogram(0.0, 1.0).mean)


def test_the_bars_of_a_window_hold_every_value_of_all_histograms():
    some, others = Histogram(0.0, 9.6).add(values_of()), Histogram(0.0, 9.6).add(values_of(4, 100) - 1.1)
    window = window_of([some, others], 40)
    assert some.bars(window).sum() == 5_000 and others.bars(window).sum() == 100
    assert 20 <= window.number <= 40
    assert (
        some.edge(window, 0) <= (values_of(4, 100) - 1.1).min() < values_of().max() <= some.edge(window, window.number)
    )


def test_a_window_that_ends_past_the_range_and_one_of_nothing():
    histogram = Histogram(0.0, 1.0).add([1.0])
    assert histogram.bars(Window(FINE - 3, 5, 1)).tolist() == [1]
    assert Histogram(0.0, 1.0).bars(window_of([Histogram(0.0, 1.0)], 40)).tolist() == [0] * 40


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_values_that_are_all_equal_are_one_bar_with_room_beside_it(value):
    histogram = Histogram(0.0, 1.0).add([value] * 9)
    window = window_of([histogram], 40)
    bars = histogram.bars(window)
    assert sorted(bars.tolist())[-2:] == [0, 9] and len(bars) >= 24
    assert histogram.edge(window, window.number) - histogram.edge(window, 0) == pytest.approx(0.1, abs=0.01)
