"""Elevations of things above a level, against boxes whose elevations are known."""

import numpy as np
import trimesh

from workers.render.raster.heightfield import column_extents


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
