"""Vertical distances, against closed forms."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from workers.physics.support import sample_elevation, vertical_gap


def mesh(m: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(m.vertices), np.asarray(m.faces, dtype=np.int32))


BOX = trimesh.creation.box((2, 2, 0.1))


def test_a_box_has_its_top_its_bottom_and_nothing_beside_it():
    points = np.array([[0.0, 0.0], [0.9, -0.9], [1.1, 0.0]])
    assert sample_elevation(points, mesh(BOX))[:2] == pytest.approx(0.05)
    assert sample_elevation(points, mesh(BOX), highest=False)[:2] == pytest.approx(-0.05)
    assert np.isnan(sample_elevation(points, mesh(BOX))[2])


def test_a_slope_has_the_height_of_its_plane():
    slope = Mesh(np.array([[0, 0, 0], [2, 0, 1], [0, 2, 3.0]]), np.array([[0, 1, 2]], np.int32))
    assert sample_elevation(np.array([[0.4, 0.6]]), slope)[0] == pytest.approx(0.4 * 0.5 + 0.6 * 1.5)


def test_a_point_on_a_shared_edge_is_not_missed():
    assert np.isfinite(sample_elevation(np.array([[0.3, 0.3], [0.0, 0.0], [1.0, 1.0]]), mesh(BOX))).all()


@pytest.mark.parametrize("gap", [-0.003, 0.0, 0.02])
def test_the_gap_of_a_sphere_above_a_box_is_known(gap):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    ball.apply_translation([0.2, 0.1, 0.05 - ball.bounds[0, 2] + gap])
    assert vertical_gap(mesh(ball), mesh(BOX)) == pytest.approx(gap, abs=1e-12)


def test_a_plate_on_a_spike_is_held_by_the_spike():
    spike = trimesh.creation.cone(radius=0.05, height=0.2)
    plate = trimesh.creation.box((1, 1, 0.02))
    plate.apply_translation([0.1, 0.1, 0.2 + 0.01 + 0.004])
    assert vertical_gap(mesh(plate), mesh(spike)) == pytest.approx(0.004, abs=1e-12)


def test_nothing_below_is_an_infinite_gap():
    far = trimesh.creation.box((0.1, 0.1, 0.1))
    far.apply_translation([5, 5, 1])
    assert vertical_gap(mesh(far), mesh(BOX)) == np.inf
