"""Axes: what they hold, and where their ticks are."""

from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from services.study.axes import MOST_TICKS, new_picture, round_ticks, set_scale

POSITIVE = st.floats(1e-9, 1e9)


def axes_of(values: list[float], side: Literal["x", "y"] = "y") -> Axes:
    axes = new_picture(4.0, 3.0, 0.0).add_subplot()
    set_scale(axes, side, values)
    return axes


def share_of(axes: Axes, value: float) -> float:
    """How far up the axis a value is drawn, from 0 to 1."""
    pixels = axes.transData.transform((1.0, value))
    return float(axes.transAxes.inverted().transform(pixels)[1])


@given(st.lists(st.one_of(st.just(0.0), POSITIVE), min_size=1))
def test_every_value_has_room_within_the_axis(values: list[float]):
    axes = axes_of(values)
    for value in values:
        assert 0.04 <= share_of(axes, value) <= 0.96


@given(st.lists(POSITIVE, min_size=1))
def test_nought_stands_well_below_the_least(values: list[float]):
    axes = axes_of([0.0, *values])
    assert axes.get_yscale() == "symlog"
    assert share_of(axes, min(values)) - share_of(axes, 0.0) > 0.1
    assert axes.get_yticks()[0] == 0.0 and all(tick > 0.0 for tick in axes.get_yticks()[1:])
    assert axes_of(values).get_yscale() == "log"


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


def test_ticks_are_written_as_plain_numbers():
    axes = axes_of([500.0, 60_000.0], "x")
    assert [axes.xaxis.get_major_formatter()(tick) for tick in axes.get_xticks()] == [
        "1,000",
        "3,000",
        "10,000",
        "30,000",
    ]


def test_an_axis_of_nothing_is_a_bug():
    with pytest.raises(ValueError, match="needs a value"):
        axes_of([])
