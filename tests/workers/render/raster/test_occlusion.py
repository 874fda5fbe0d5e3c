"""Sky visibility above a level, against closed forms, and elevations, against boxes whose elevations are known."""

import math

import numpy as np
import pytest
import trimesh

from workers.render.raster.baking import column_extents, sky_visibility


def test_nothing_hides_nothing():
    nothing = np.zeros((32, 32), np.float32)
    assert (sky_visibility(nothing, nothing, nothing, 0.01) == 1.0).all()


def test_a_long_wall_hides_what_its_form_factor_says():
    """A wall of height h at distance d, endless: half of 1 - d / sqrt(d^2 + h^2) of the sky."""
    top, nothing, step = np.zeros((120, 120), np.float32), np.zeros((120, 120), np.float32), 0.01
    top[:, 60:] = 0.06
    seen = sky_visibility(top, nothing, nothing, step)
    for steps in (2, 4, 8):
        d = (steps + 0.0) * step
        expected = 1.0 - 0.5 * (1.0 - d / math.hypot(d, 0.06))
        assert seen[60, 60 - steps] == pytest.approx(expected, abs=0.06)


def test_a_board_overhead_hides_the_sky_and_lets_light_in_from_the_sides():
    top, under = np.zeros((80, 80), np.float32), np.zeros((80, 80), np.float32)
    top[30:50, 30:50], under[30:50, 30:50] = 0.12, 0.1
    seen = sky_visibility(top, under, np.zeros_like(top), 0.01)
    assert 0.35 < seen[40, 40] < 0.7
    assert seen[40, 40] < seen[40, 52] < seen[40, 70] <= 1.0
    higher = sky_visibility(top + 0.3 * (top > 0), under + 0.3 * (top > 0), np.zeros_like(top), 0.01)
    assert higher[40, 40] > seen[40, 40]


def test_a_box_that_hangs_over_a_level_has_its_bottom_and_its_top_in_its_own_cells_alone():
    """Cells of 1 cm from (-0.1, -0.1): the box from -2 to 4 cm along x and -3 to 3 cm along y covers 6 x 6 of them."""
    box = trimesh.creation.box((0.06, 0.06, 0.05))
    box.apply_translation((0.01, 0.0, 0.125))
    top, under = column_extents(box.vertices, box.faces, np.array([-0.1, -0.1, 0.02]), 0.01, 20)
    inside = np.zeros((20, 20), bool)
    inside[7:13, 8:14] = True
    assert np.abs(top[inside] - 0.13).max() < 1e-6
    assert np.abs(under[inside] - 0.08).max() < 1e-6
    assert (top[~inside] == 0.0).all() and (under[~inside] == 0.0).all()


def test_points_below_the_level_count_as_on_it():
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    top, under = column_extents(box.vertices, box.faces, np.array([-0.1, -0.1, 0.0]), 0.01, 20)
    assert abs(top[10, 10] - 0.05) < 1e-6 and under[10, 10] == 0.0
