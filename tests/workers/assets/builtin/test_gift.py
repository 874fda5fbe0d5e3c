"""Boxes with a lid: the lid is wider than the box, and a ribbon is joined to it."""

import numpy as np
import pytest
import trimesh

from workers.assets.builtin.gift import EXTRA, LID, SIDE, make_lidded


@pytest.mark.parametrize("seed", range(25))
def test_the_lid_overhangs_the_box_and_a_ribbon_goes_all_around(seed):
    solid = make_lidded(np.random.default_rng(seed)).solid
    corners = solid.vertices[solid.faces]
    lid, side = (corners[solid.surface == s].reshape(-1, 3) for s in (LID, SIDE))
    assert np.ptp(lid[:, 0]) > np.ptp(side[:, 0]) + 0.002
    assert lid[:, 2].min() > 0.4 * side[:, 2].max()
    ribbon = corners[solid.surface == EXTRA].reshape(-1, 3)
    if len(ribbon):
        assert np.ptp(ribbon[:, 0]) > np.ptp(lid[:, 0])
        assert ribbon[:, 2].min() == 0.0
        assert ribbon[:, 2].max() > lid[:, 2].max()
    mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    assert mesh.is_volume
    assert mesh.body_count == 1
