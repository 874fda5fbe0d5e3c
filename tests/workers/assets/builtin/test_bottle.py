"""Bottles: a body, a neck, a cap; every kind is made."""

import numpy as np
import pytest

from workers.assets.builtin.bottle import BODY, CAP, KINDS, LABEL, make_bottle
from workers.assets.builtin.make import make_model


@pytest.mark.parametrize("index", range(25))
def test_a_bottle_narrows_from_its_body_to_its_neck_and_is_closed_by_a_cap(index):
    solid = make_model("bottle", 0, index).solid
    corners = solid.vertices[solid.faces]
    height = solid.vertices[:, 2].max()
    cap = corners[solid.surface == CAP].reshape(-1, 3)
    body = corners[np.isin(solid.surface, (BODY, LABEL))].reshape(-1, 3)
    widths = [np.ptp(points[:, 0]) for points in (cap, body)]
    assert cap[:, 2].max() == height
    assert cap[:, 2].min() > 0.45 * height
    assert widths[0] <= widths[1] * 1.001
    rings = np.hypot(*body[body[:, 2] > body[:, 2].max() - 0.02 * height][:, :2].T)
    assert rings.max() < 0.5 * widths[1]


def test_every_kind_of_bottle_turns_up():
    assert len(KINDS) == len(set(KINDS))
    drawn = {int(np.random.default_rng(seed).integers(len(KINDS))) for seed in range(200)}
    assert drawn == set(range(len(KINDS)))  # the first number that make_bottle draws
    for seed in range(20):
        assert make_bottle(np.random.default_rng(seed)).surfaces
