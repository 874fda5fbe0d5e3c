"""Bowls: wide, open, hollow."""

import pytest

from tests.workers.assets.builtin.bottom_heights import bottom_heights
from workers.assets.builtin.make import make_model


@pytest.mark.parametrize("index", range(25))
def test_a_bowl_is_wider_than_high_and_its_bottom_is_a_wall(index):
    inner, outer = bottom_heights("bowl", index)
    size = make_model("bowl", 0, index).solid.vertices
    assert 0.003 < inner - outer < 0.012
    assert outer > 0.0  # the foot ring lifts it
    assert size[:, 0].max() - size[:, 0].min() > 1.4 * size[:, 2].max()
