"""Draws: picks and chances; colours in range, readable."""

import numpy as np
import pytest

from workers.assets.builtin import materials as palette


@pytest.mark.parametrize("draw", [palette.vivid, palette.pale, palette.glaze_color, palette.glass_color])
def test_every_colour_is_within_range(draw):
    rng = np.random.default_rng(0)
    colors = np.array([draw(rng) for _ in range(300)])
    assert colors.shape == (300, 3)
    assert colors.min() >= 0.0
    assert colors.max() <= 1.0
    assert len(np.unique(colors, axis=0)) > 200


def test_ink_can_be_read_on_its_paper():
    rng = np.random.default_rng(1)
    for _ in range(300):
        paper = palette.vivid(rng) if rng.random() < 0.5 else palette.pale(rng)
        ink = palette.ink_on(rng, paper)
        assert max(abs(a - b) for a, b in zip(ink, paper, strict=True)) > 0.1


def test_mixing_and_lightness_are_linear():
    assert palette.mix((0, 0, 0), (1, 1, 1), 0.25) == (0.25, 0.25, 0.25)
    assert palette.lightness((1, 1, 1)) == pytest.approx(1.0)
    assert palette.hsv(1 / 3, 1, 1) == pytest.approx((0, 1, 0))


def test_picks_are_even_and_chances_are_what_they_say():
    rng = np.random.default_rng(3)
    picks = [palette.pick(rng, "abcd") for _ in range(4000)]
    assert min(picks.count(c) for c in "abcd") > 850
    assert sum(palette.chance(rng, 0.3) for _ in range(4000)) == pytest.approx(1200, abs=150)
