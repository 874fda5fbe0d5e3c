"""Prisms and rods against volumes of the textbook."""

import math

import numpy as np
import pytest
import trimesh

from workers.assets.builtin.solid import circle
from workers.assets.builtin.sweeps import bend_radius, bevelled_profile, prism, rod, split_sides


def mesh_of(solid):
    return trimesh.Trimesh(solid.vertices, solid.faces, process=False)


def test_a_prism_has_its_size_and_the_volume_of_a_box_without_its_corners():
    mesh = mesh_of(prism(np.array([[0.0, 0.0], [0.0, 0.3]]), (0.4, 0.2), 0.05, [0] * 3, 32))
    assert mesh.is_volume
    assert mesh.bounds == pytest.approx(np.array([[-0.2, -0.1, 0.0], [0.2, 0.1, 0.3]]))
    assert mesh.volume == pytest.approx(0.3 * (0.08 - (4 - math.pi) * 0.0025), rel=1e-3)


def test_a_bevel_is_taken_off_both_edges():
    assert bevelled_profile(0.1, 0.01, 1.0).tolist() == pytest.approx(
        np.array([[0.01, 1], [0, 1.01], [0, 1.09], [0.01, 1.1]])
    )


def test_a_rod_bent_into_a_half_circle_has_the_volume_that_pappus_gives_it():
    turn = np.linspace(0, math.pi, 200)
    path = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ends = np.array([0.0, 1.0]), np.array([0.0, -1.0])
    mesh = mesh_of(rod(path, 0.1 * circle(64), 0, ends))
    assert mesh.is_volume
    assert mesh.volume == pytest.approx(math.pi * math.pi * 0.01, rel=5e-3)


def test_a_rod_may_be_as_thick_as_its_tightest_bend_is_wide():
    turn = np.linspace(0, math.pi, 200)
    path = 0.3 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    assert bend_radius(path, (np.array([0.0, 1.0]), np.array([0.0, -1.0]))) == pytest.approx(0.3, rel=1e-3)


def test_a_prism_without_room_for_its_edges_is_a_bug_and_says_so():
    with pytest.raises(ValueError, match="no room for an inset"):
        prism(np.array([[0.0, 0.0], [0.06, 0.3]]), (0.4, 0.1), 0.01, [0] * 3)


def test_the_sides_of_a_box_are_told_apart():
    solid = split_sides(prism(np.array([[0.0, 0.0], [0.0, 1.0]]), (2.0, 1.0), 0.01, [9, 0, 9]), 0, (1, 2, 3, 4))
    centres = solid.vertices[solid.faces].mean(axis=1)
    for number, (axis, sign) in {1: (1, -1), 2: (0, 1), 3: (1, 1), 4: (0, -1)}.items():
        assert (sign * centres[solid.surface == number][:, axis] > 0.4).all()
    assert (solid.surface == 9).sum() == 2 * 16
