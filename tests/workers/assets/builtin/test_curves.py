"""Curves against their definitions."""

import math

import numpy as np
import pytest
from shapely.geometry import Polygon

from workers.assets.builtin.solid import circle
from workers.assets.builtin.sweeps import (
    bezier,
    fillet,
    half_circle_points,
    outward_normals,
    rounded_rectangle,
    rounded_sections,
    spline,
    squircle,
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


def test_a_corner_that_is_not_rounded_stays():
    corners = np.array([[0.0, 0], [1, 0], [1, 1]])
    points, owner = fillet(corners, [0, 0, 0])
    assert points.tolist() == corners.tolist()
    assert owner.tolist() == [0, 1]


def test_outwards_is_down_along_a_floor_and_out_of_a_wall():
    normals = outward_normals(np.array([[0.0, 0], [1, 0], [2, 0]]))
    assert normals == pytest.approx(np.array([[0, -1]] * 3))
    assert outward_normals(np.array([[1.0, 0], [1, 1], [1, 2]])) == pytest.approx(np.array([[1, 0]] * 3))


def test_a_rim_is_a_half_circle_over_the_wall():
    points = half_circle_points(np.array([2.0, 5.0]), np.array([1.0, 5.0]), 3)
    assert points[1] == pytest.approx([1.5, 5.5])
    assert np.hypot(points[:, 0] - 1.5, points[:, 1] - 5.0) == pytest.approx(np.full(3, 0.5))
    assert points[0, 0] > points[2, 0]


@pytest.mark.parametrize("squareness", [0, 1, 2])
def test_a_squircle_satisfies_its_equation(squareness):
    power = 2 ** (squareness + 1)
    assert (np.abs(squircle(48, squareness)) ** power).sum(axis=1) == pytest.approx(np.ones(48), rel=1e-12)


def test_a_rounded_rectangle_has_its_size_and_runs_counter_clockwise():
    outline = Polygon(rounded_rectangle(4.0, 2.0, 0.5, 32))
    assert outline.exterior.is_ccw
    assert outline.bounds == pytest.approx((-2, -1, 2, 1))
    assert outline.area == pytest.approx(8 - (4 - math.pi) * 0.25, rel=1e-3)


def test_sections_turn_from_a_circle_into_an_outline():
    sections = rounded_sections(squircle(16, 2), np.array([0.0, 0.25, 1.0]))
    assert sections[0].tolist() == circle(16).tolist()
    assert sections[2].tolist() == squircle(16, 2).tolist()
    assert sections[1] == pytest.approx(0.75 * sections[0] + 0.25 * sections[2])
