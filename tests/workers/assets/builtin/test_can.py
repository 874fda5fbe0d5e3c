"""Cans: round, with rims that stand above the lid."""

import numpy as np
import pytest

from tests.workers.assets.oracles import hits
from workers.assets.builtin.can import SIDE, TOP
from workers.assets.builtin.make import make_model


@pytest.mark.parametrize("index", range(25))
def test_a_can_is_round_and_its_lid_lies_below_its_rim_unless_it_has_a_cap(index):
    solid = make_model("can", 0, index).solid
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    assert (high - low)[0] == pytest.approx((high - low)[1], rel=1e-9)
    distances, _ = hits(solid.vertices, solid.faces, np.array([1e-4, 2e-4, 1.0]), np.array([0.0, 0.0, -1.0]))
    middle = 1.0 - distances[0]
    has_cap = bool((solid.surface == TOP).any())
    assert middle == pytest.approx(high[2]) if has_cap else middle < high[2] - 0.0008
    assert (solid.surface == SIDE).any()
