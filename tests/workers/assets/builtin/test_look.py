"""Colours: in range, readable, repeatable."""

import numpy as np
import pytest

from workers.assets.builtin import look


@pytest.mark.parametrize("draw", [look.vivid, look.pale, look.glaze_color, look.glass_color])
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
        paper = look.vivid(rng) if rng.random() < 0.5 else look.pale(rng)
        ink = look.ink_on(rng, paper)
        assert max(abs(a - b) for a, b in zip(ink, paper, strict=True)) > 0.1


def test_mixing_and_lightness_are_linear():
    assert look.mixed((0, 0, 0), (1, 1, 1), 0.25) == (0.25, 0.25, 0.25)
    assert look.lightness((1, 1, 1)) == pytest.approx(1.0)
    assert look.hsv(1 / 3, 1, 1) == pytest.approx((0, 1, 0))


def test_materials_are_within_what_gltf_allows():
    rng = np.random.default_rng(2)
    for draw in (look.plastic, look.steel, look.metal):
        for _ in range(100):
            material = draw(rng)
            assert 0.0 <= material.metallic <= 1.0
            assert 0.05 <= material.roughness <= 1.0
            assert material.base_color[3] == 1.0


def test_picks_are_even_and_chances_are_what_they_say():
    rng = np.random.default_rng(3)
    picks = [look.pick(rng, "abcd") for _ in range(4000)]
    assert min(picks.count(c) for c in "abcd") > 850
    assert sum(look.chance(rng, 0.3) for _ in range(4000)) == pytest.approx(1200, abs=150)
