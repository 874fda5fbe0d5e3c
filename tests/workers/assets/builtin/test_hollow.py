"""Walls of vessels."""

import numpy as np
import pytest
import trimesh
from shapely.geometry import Polygon

from workers.assets.builtin.solid import lathe
from workers.assets.builtin.sweeps import BASE, INSIDE, OUTSIDE, wall_around


def mesh_of(solid):
    return trimesh.Trimesh(solid.vertices, solid.faces, process=False)


def beaker():
    hollow = np.array([[0.0, 0.01], [0.03, 0.01], [0.04, 0.02], [0.04, 0.1]])
    return wall_around(hollow, 0.004, 0.025, 0.004, 0.001)


def test_a_wall_is_as_thick_as_it_says_and_its_profile_does_not_cross_itself():
    wall = beaker()
    assert Polygon(wall.profile).is_valid
    assert wall.radius_at(0.099) == pytest.approx(0.044, abs=1e-5)
    assert wall.normal_at(0.06) == pytest.approx([1, 0], abs=1e-2)
    assert set(wall.surface) == {OUTSIDE, INSIDE, BASE}
    assert mesh_of(lathe(wall.profile, wall.surface)).is_volume


def test_a_vessel_stands_on_its_foot_ring_and_holds_what_its_hollow_says():
    wall = beaker()
    mesh = mesh_of(lathe(wall.profile, wall.surface, 256))
    ring = mesh.vertices[mesh.vertices[:, 2] == 0.0]
    assert np.hypot(ring[:, 0], ring[:, 1]).min() == pytest.approx(0.021)
    assert np.hypot(ring[:, 0], ring[:, 1]).max() == pytest.approx(0.025)
    inside = wall.surface == INSIDE
    assert wall.profile[1:][inside][-1].tolist() == [0.0, 0.01]


def test_the_middle_of_a_wall_lies_half_its_thickness_inside():
    assert beaker().middle_at(0.06) == pytest.approx([0.042, 0.06], abs=5e-5)
