"""Laptops: open, leaning back, standing by themselves."""

import math

import numpy as np
import pytest

from workers.assets.builtin.laptop import DECK, SCREEN
from workers.assets.builtin.make import make_model


def normals_of(solid, surface):
    a, b, c = (solid.vertices[solid.faces[solid.surface == surface][:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    return across / np.linalg.norm(across, axis=1)[:, None], np.linalg.norm(across, axis=1)


@pytest.mark.parametrize("index", range(25))
def test_the_screen_faces_the_user_and_leans_back_between_5_and_40_degrees(index):
    solid = make_model("laptop", 0, index).solid
    normals, areas = normals_of(solid, SCREEN)
    facing = normals[areas.argmax()]
    assert facing[0] == pytest.approx(0, abs=1e-9)
    assert facing[1] < 0  # the user sits at -y
    lean = math.degrees(math.asin(facing[2]))
    assert 5.0 <= lean <= 40.0


@pytest.mark.parametrize("index", range(25))
def test_the_keys_lie_below_the_case_in_front_of_the_screen(index):
    solid = make_model("laptop", 0, index).solid
    deck = solid.vertices[solid.faces[solid.surface == DECK]].reshape(-1, 3)
    screen = solid.vertices[solid.faces[solid.surface == SCREEN]].reshape(-1, 3)
    assert deck[:, 1].max() < screen[:, 1].min()
    assert screen[:, 2].max() > 5 * deck[:, 2].max()
    normals, areas = normals_of(solid, DECK)
    assert normals[areas.argmax()] == pytest.approx([0, 0, 1])
