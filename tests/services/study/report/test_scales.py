"""Axes: what they hold, and where their ticks are."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.study.report.scales import MOST_TICKS, round_ticks, scale_of

POSITIVE = st.floats(1e-9, 1e9)


@given(st.lists(st.one_of(st.just(0.0), POSITIVE), min_size=1))
def test_every_value_has_room_within_the_axis(values: list[float]):
    scale = scale_of(values)
    ends = math.log(scale.low), math.log(scale.high)
    for value in values:
        share = (math.log(scale.place(value)) - ends[0]) / (ends[1] - ends[0])
        assert 0.04 <= share <= 0.96


@given(st.lists(POSITIVE, min_size=1))
def test_nought_stands_well_below_the_least(values: list[float]):
    scale = scale_of([0.0, *values])
    assert scale.zero is not None
    gap = math.log(min(values) / scale.place(0.0)) / math.log(scale.high / scale.low)
    assert gap > 0.1
    assert all(tick > scale.zero for tick in scale.ticks)
    assert scale_of(values).zero is None


@given(POSITIVE, st.floats(1.2, 1e12))
def test_ticks_are_few_and_within_the_axis(low: float, times: float):
    ticks = round_ticks(low, low * times)
    assert 2 <= len(ticks) <= MOST_TICKS + 1
    assert all(low * (1 - 1e-9) <= tick <= low * times * (1 + 1e-9) for tick in ticks)
    assert sorted(set(ticks)) == list(ticks)


def test_ticks_are_round():
    assert round_ticks(0.01, 12.0) == pytest.approx((0.01, 0.1, 1.0, 10.0))
    assert round_ticks(60.0, 700.0) == pytest.approx((100, 200, 500))
    assert round_ticks(108.0, 151.0) == pytest.approx((110, 120, 130, 140, 150))


def test_an_axis_of_nothing_is_a_bug():
    with pytest.raises(ValueError, match="needs a value"):
        scale_of([])
