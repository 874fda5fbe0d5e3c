"""Jars: open, hollow, narrower at the neck than at the belly."""

import numpy as np
import pytest
from shapely.geometry import Polygon

from tests.workers.assets.builtin.bottom_heights import bottom_heights
from workers.assets.builtin.jar import _glass_jar, _pot
from workers.assets.builtin.make import make_model
from workers.assets.builtin.sweeps import OUTSIDE


@pytest.mark.parametrize("index", range(25))
def test_a_jar_is_open_down_to_a_bottom_as_thick_as_a_wall(index):
    inner, outer = bottom_heights("jar", index)
    assert 0.002 < inner - outer < 0.012
    assert outer < 0.004


@pytest.mark.parametrize("index", range(25))
def test_a_jar_has_a_neck(index):
    solid = make_model("jar", 0, index).solid
    points = solid.vertices[solid.faces[solid.surface == OUTSIDE]].reshape(-1, 3)
    radius, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2] / points[:, 2].max()
    neck = radius[(z > 0.78) & (z < 0.93)]
    assert neck.min() < 0.97 * radius[z < 0.75].max()


@pytest.mark.parametrize("make", [_glass_jar, _pot])
def test_no_wall_crosses_itself(make):
    for seed in range(300):
        assert Polygon(make(np.random.default_rng(seed)).profile).is_valid, seed
