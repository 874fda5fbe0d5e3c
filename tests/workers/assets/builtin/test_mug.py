"""Mugs: hollow, open, with a handle that a finger goes through and that does not show inside."""

import numpy as np
import pytest
from shapely.geometry import Polygon

from tests.workers.assets.builtin.bottom_heights import bottom_heights
from tests.workers.assets.oracles import hits
from workers.assets.builtin.crockery import HANDLE, _body, _handle
from workers.assets.builtin.make import make_model
from workers.assets.builtin.sweeps import INSIDE


@pytest.mark.parametrize("index", range(25))
def test_a_mug_is_open_down_to_a_bottom_as_thick_as_a_wall(index):
    inner, outer = bottom_heights("mug", index)
    height = make_model("mug", 0, index).solid.vertices[:, 2].max()
    assert 0.0 <= outer < 0.003
    assert 0.002 < inner - outer < 0.012
    assert inner < 0.15 * height


@pytest.mark.parametrize("index", range(25))
def test_the_handle_stays_out_of_the_hollow_and_leaves_room_for_a_finger(index):
    solid = make_model("mug", 0, index).solid
    points = solid.vertices[solid.faces[solid.surface == HANDLE]].reshape(-1, 3)
    inner = solid.vertices[solid.faces[solid.surface == INSIDE]].reshape(-1, 3)
    for low, high in ((0.1, 0.5), (0.5, 0.9)):  # compare radii at like heights
        z = solid.vertices[:, 2].max() * np.array([low, high])
        at = [p[(p[:, 2] >= z[0]) & (p[:, 2] <= z[1])] for p in (points, inner)]
        if len(at[0]) and len(at[1]):
            assert np.hypot(*at[0][:, :2].T).min() > np.hypot(*at[1][:, :2].T).max() - 0.012
    middle = 0.5 * (points[:, 2].min() + points[:, 2].max())
    distances, sides = hits(solid.vertices, solid.faces, np.array([1.0, 1e-5, middle]), np.array([-1.0, 0.0, 0.0]))
    gap = distances[2] - distances[1]  # from the inside of the handle to the wall
    assert sides[:3].tolist() == [-1, 1, -1]
    assert gap > 0.012


def test_no_wall_crosses_itself_and_no_handle_folds_at_its_bends():
    for seed in range(600):
        rng = np.random.default_rng(seed)
        wall = _body(rng)
        assert Polygon(wall.profile).is_valid, seed
        handle = _handle(rng, wall)
        rings = handle.vertices[:-2].reshape(-1, 12, 3)
        along = np.diff(rings, axis=0)  # from each ring to the next, at twelve places around
        middle = np.diff(rings.mean(axis=1), axis=0)[:, None]
        assert ((along * middle).sum(axis=2) > 0).all(), seed  # where it folds, its inner side runs back
