"""Plane curves, swept solids and walls of vessels."""

import math

import numpy as np
import pytest
import trimesh
from shapely.geometry import Polygon

from workers.assets.builtin.solid import circle, lathe
from workers.assets.builtin.sweeps import (
    BASE,
    INSIDE,
    OUTSIDE,
    bend_radius,
    bezier,
    fillet,
    prism,
    rod,
    rounded_rectangle,
    spline,
    split_sides,
    squircle,
    wall_around,
)


def test_a_bezier_curve_goes_through_its_ends_along_its_handles_and_through_the_known_middle():
    a, b, c, d = (np.array(p, float) for p in ([0, 0], [0, 3], [4, 3], [4, 0]))
    curve = bezier(a, b, c, d, 101)
    assert curve[[0, -1]].tolist() == [[0, 0], [4, 0]]
    assert curve[50] == pytest.approx((a + 3 * b + 3 * c + d) / 8)
    assert curve[1][0] / curve[1][1] < 0.05


def test_a_spline_goes_through_its_points_and_a_straight_one_stays_straight():
    points = np.array([[0.0, 0], [1, 2], [3, 3], [2, 5]])
    curve = spline(points, 7)
    assert curve[::7] == pytest.approx(points)
    line = spline(np.array([[0.0, 0], [1, 1], [2, 2]]), 5)
    assert line[:, 0] == pytest.approx(line[:, 1])


def test_a_rounded_corner_leaves_and_meets_its_sides_and_knows_them():
    corners = np.array([[0.0, 0], [1, 0], [1, 1]])
    points, owner = fillet(corners, [0, 0.2, 0], 4)
    assert points[1] == pytest.approx([0.8, 0])
    assert points[-2] == pytest.approx([1, 0.2])
    assert owner.tolist() == [0, 0, 0, 1, 1, 1]
    assert Polygon([*points, [0, 1]]).area == pytest.approx(1 - 0.2 * 0.2 / 3, rel=0.02)  # a parabola cuts off a third


@pytest.mark.parametrize("squareness", [0, 1, 2])
def test_a_squircle_satisfies_its_equation(squareness):
    power = 2 ** (squareness + 1)
    assert (np.abs(squircle(48, squareness)) ** power).sum(axis=1) == pytest.approx(np.ones(48), rel=1e-12)


def test_a_rounded_rectangle_has_its_size_and_runs_counter_clockwise():
    outline = Polygon(rounded_rectangle(4.0, 2.0, 0.5, 32))
    assert outline.exterior.is_ccw
    assert outline.bounds == pytest.approx((-2, -1, 2, 1))
    assert outline.area == pytest.approx(8 - (4 - math.pi) * 0.25, rel=1e-3)


def mesh_of(solid):
    return trimesh.Trimesh(solid.vertices, solid.faces, process=False)


def test_a_prism_has_its_size_and_the_volume_of_a_box_without_its_corners():
    mesh = mesh_of(prism(np.array([[0.0, 0.0], [0.0, 0.3]]), (0.4, 0.2), 0.05, [0] * 3, 32))
    assert mesh.is_volume
    assert mesh.bounds == pytest.approx(np.array([[-0.2, -0.1, 0.0], [0.2, 0.1, 0.3]]))
    assert mesh.volume == pytest.approx(0.3 * (0.08 - (4 - math.pi) * 0.0025), rel=1e-3)


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


def wall_mesh(solid):
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
    assert wall_mesh(lathe(wall.profile, wall.surface)).is_volume


def test_a_vessel_stands_on_its_foot_ring_and_holds_what_its_hollow_says():
    wall = beaker()
    mesh = wall_mesh(lathe(wall.profile, wall.surface, 256))
    ring = mesh.vertices[mesh.vertices[:, 2] == 0.0]
    assert np.hypot(ring[:, 0], ring[:, 1]).min() == pytest.approx(0.021)
    assert np.hypot(ring[:, 0], ring[:, 1]).max() == pytest.approx(0.025)
    inside = wall.surface == INSIDE
    assert wall.profile[1:][inside][-1].tolist() == [0.0, 0.01]
