"""What tables stand on: every kind reaches the ground and the top."""

import numpy as np
import pytest

from workers.assets.builtin.solid import union
from workers.assets.builtin.table_base import FRAME, LEG, TOP, TableSize, make_base


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
