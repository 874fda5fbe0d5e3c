"""Picks and chances."""

import numpy as np
import pytest

from workers.assets.builtin import draws


def test_picks_are_even_and_chances_are_what_they_say():
    rng = np.random.default_rng(3)
    picks = [draws.pick(rng, "abcd") for _ in range(4000)]
    assert min(picks.count(c) for c in "abcd") > 850
    assert sum(draws.chance(rng, 0.3) for _ in range(4000)) == pytest.approx(1200, abs=150)
