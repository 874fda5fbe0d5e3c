"""Amounts as a person reads them."""

import pytest

from services.study.model import amount, as_often, listed, milliseconds, number, size, times


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.1, "0.1"),
        (0.00012345, "0.000123"),
        (99999, "100,000"),
        (13.44, "13.4"),
        (100.0, "100"),
        (1250.0, "1,250"),
        (9.75e-6, "9.75e-6"),
        (2.5e7, "2.5e7"),
        (-0.02, "-0.02"),
        (float("nan"), "nan"),
    ],
)
def test_a_number_has_three_digits(value: float, text: str):
    assert number(value) == text


def test_amounts_have_their_units_and_shares_are_per_cent():
    assert amount("penetration_mm", 0.1) == "0.1 mm"
    assert amount("mask_share", 0.001) == "0.1 %"
    assert amount("flip", 0.12) == "0.12"
    assert amount("turned_deg", 0.01) == "0.01 deg"


def test_ratios_within_noise_are_one():
    assert [as_often(ratio) for ratio in (0.62, 0.96, 1.04, 1.6, 47.2, 1419.0)] == [
        "0.62",
        "1",
        "1",
        "1.6",
        "47",
        "1,400",
    ]
    assert [times(ratio) for ratio in (0.5, 0.96, 1.068, 1.58)] == [
        "0.5 times",
        "0.96 times",
        "1.07 times",
        "1.6 times",
    ]


def test_times_and_sizes_have_the_unit_that_keeps_them_short():
    assert [size(kb) for kb in (235, 15040, 2.35e8, 3e12)] == ["235 kB", "15 MB", "235 GB", "3,000 TB"]
    assert [milliseconds(ms) for ms in (117.6, 5600, 11200)] == ["118 ms", "5,600 ms", "11.2 s"]


def test_words_are_listed():
    assert [listed(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == ["", "a", "a and b", "a, b and c"]
