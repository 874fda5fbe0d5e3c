"""Cameras: a lens that looks forward, sunken glass, nothing below the base."""

import numpy as np
import pytest

from workers.assets.builtin.camera import DISPLAY, GLASS, LENS, SHELL
from workers.assets.builtin.make import make_model


def points_of(solid, *surfaces):
    return solid.vertices[solid.faces[np.isin(solid.surface, surfaces)]].reshape(-1, 3)


@pytest.mark.parametrize("index", range(25))
def test_the_lens_stands_out_in_front_with_its_glass_behind_its_rim_and_the_display_is_behind(index):
    solid = make_model("camera", 0, index).solid
    lens, glass, shell, display = (points_of(solid, s) for s in (LENS, GLASS, SHELL, DISPLAY))
    assert lens[:, 1].min() < shell[:, 1].min() - 0.004
    assert lens[:, 1].min() < glass[:, 1].min()
    assert display[:, 1].max() > shell[:, 1].max()


@pytest.mark.parametrize("index", range(25))
def test_only_the_base_of_the_body_touches_the_ground(index):
    solid = make_model("camera", 0, index).solid
    lowest = solid.vertices[:, 2].min()
    touching = {int(s) for s in solid.surface[(solid.vertices[solid.faces][:, :, 2] == lowest).any(axis=1)]}
    assert touching == {SHELL}
    assert points_of(solid, LENS)[:, 2].min() > 0.001
