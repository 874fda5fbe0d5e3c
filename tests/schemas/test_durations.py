"""Durations in words."""

import pytest

from schemas.errors import describe_seconds


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, "0 s"),
        (0.1178, "0.12 s"),
        (7.552, "7.6 s"),
        (59.0, "59 s"),
        (90.0, "1.5 min"),
        (300.0, "5 min"),
        (5399.0, "90 min"),
        (7200.0, "2 h"),
        (9000.0, "2.5 h"),
        (31 * 3600.0, "31 h"),
        (9 * 86400.0, "9 d"),
        (4321 * 86400.0, "4321 d"),
    ],
)
def test_a_duration_is_told_in_one_unit_with_two_digits(seconds, words):
    assert describe_seconds(seconds) == words
