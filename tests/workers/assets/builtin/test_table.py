"""Tables: level, thick enough, below every object that a job puts on them, on bases from the ground to the top."""

import numpy as np
import pytest

from tests.workers.assets.oracles import hits
from workers.assets.builtin.make import make_model
from workers.assets.builtin.solid import union
from workers.assets.builtin.table import FRAME, LEG, TOP, TableSize, make_base


@pytest.mark.parametrize("index", range(30))
def test_the_top_is_level_to_the_last_bit_of_the_right_thickness_and_under_every_place_of_an_object(index):
    solid = make_model("table", 0, index).solid
    top = solid.vertices[:, 2].max()
    assert 0.45 <= top <= 0.9
    size = np.ptp(solid.vertices, axis=0)
    assert 0.9 <= size[0] <= 1.8
    assert 0.8 <= size[1] <= 1.8
    for x in (-0.2501, 0.0003, 0.2502):
        for y in (-0.2487, 0.0007, 0.2493):  # off the lines along which round tops are cut
            distances, sides = hits(solid.vertices, solid.faces, np.array([x, y, 2.0]), np.array([0.0, 0.0, -1.0]))
            assert 2.0 - distances[0] == pytest.approx(top, abs=1e-12)
            assert sides[:2].tolist() == [-1, 1]
            assert distances[1] - distances[0] >= 0.0149
    flat = solid.vertices[solid.vertices[:, 2] > top - 1e-6]
    assert len(flat) > 8
    assert set(flat[:, 2]) == {top}


@pytest.mark.parametrize("round_top", [False, True])
def test_a_stand_reaches_from_the_ground_into_the_top_and_stays_below_it(round_top):
    plan = TableSize(1.2, 1.0, 0.03, 0.74, round_top)
    for seed in range(30):
        joined = union(make_base(np.random.default_rng(seed), plan))
        assert joined.vertices[:, 2].min() == 0.0
        assert plan.under < joined.vertices[:, 2].max() < plan.height
        assert (np.abs(joined.vertices[:, 0]) <= 0.5 * plan.width).all(), seed
        assert (np.abs(joined.vertices[:, 1]) <= 0.5 * plan.depth).all(), seed
        assert set(joined.surface) <= {LEG, FRAME}
        assert TOP not in joined.surface
