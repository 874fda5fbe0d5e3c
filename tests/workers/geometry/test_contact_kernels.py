"""Compiled loops over features: boxes near boxes, a corner over a face, and an edge across another."""

import numpy as np
import pytest

from workers.physics.contact_surface import bounds_in, find_near
from workers.physics.contacts import corners_on_faces, edges_across_edges

PAIR = np.array([[0, 0]])
FACE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
UP, DOWN, NEITHER = np.array([1]), np.array([-1]), np.array([0])


def test_the_pairs_that_are_near_are_those_of_every_box_with_every_other():
    rng = np.random.default_rng(0)
    low, others = rng.uniform(0, 1, (80, 3)), rng.uniform(0, 1, (300, 3))
    high, others_high = low + rng.uniform(0, 0.1, (80, 3)), others + rng.uniform(0, 0.2, (300, 3))
    found = find_near(low, high, others, others_high, 0.03)
    near = ((low[:, None] - 0.03 <= others_high) & (others - 0.03 <= high[:, None])).all(axis=2)
    assert 64 < near.sum() < 5000
    assert {tuple(pair) for pair in found.tolist()} == {tuple(pair) for pair in np.argwhere(near).tolist()}
    assert (np.diff(found[:, 0]) >= 0).all()
    assert len(find_near(low, high, others[:0], others[:0], 0.03)) == 0


def test_the_features_in_a_box_are_those_whose_bounds_overlap_it():
    rng = np.random.default_rng(1)
    points, triangles = rng.uniform(0, 1, (40, 3)), rng.integers(0, 40, (200, 3))
    low, high = np.array([0.1, 0.2, 0.7]), np.array([0.2, 0.3, 0.9])
    corners = points[triangles]
    near = ((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1)
    found, least, most = bounds_in(points, triangles, low, high)
    assert 0 < near.sum() < 200 and found.tolist() == np.flatnonzero(near).tolist()
    assert np.array_equal(least, corners.min(axis=1)[near]) and np.array_equal(most, corners.max(axis=1)[near])


def corner(at, sharp: float = 1.0, side=UP):
    """Of a tip that points down: its four neighbours lie `sharp` above it."""
    about = np.array([[1.0, 0, sharp], [-1.0, 0, sharp], [0, 1.0, sharp], [0, -1.0, sharp]])
    vertices = np.array(at) + np.concatenate([np.zeros((1, 3)), about])
    starts, members = np.array([0, 4, 4, 4, 4, 4]), np.arange(1, 5)
    rows, which = corners_on_faces(PAIR, vertices, starts, members, FACE, np.array([[0, 1, 2]]), side, 0.02, 0.02)
    assert len(rows) == len(which)
    return rows


@pytest.mark.parametrize("height", [0.015, 0.0, -0.01])
def test_a_corner_over_a_face_is_as_far_as_it_is_high_and_below_it_negative(height):
    ((*point, nx, ny, nz, gap),) = corner((0.2, 0.3, height)).tolist()
    assert point == pytest.approx([0.2, 0.3, height / 2]) and (nx, ny, nz) == (0, 0, 1) and gap == height


@pytest.mark.parametrize("at", [(0.2, 0.3, 0.021), (0.2, 0.3, -0.021), (0.6, 0.6, 0.0), (-0.001, 0.3, 0.01)], ids=str)
def test_a_corner_beside_a_face_or_far_from_its_plane_has_no_contact(at):
    assert len(corner(at)) == 0


def test_a_corner_that_points_away_touches_only_the_face_that_looks_at_it():
    assert len(corner((0.2, 0.3, -0.01), -1.0)) == 0  # its body lies below, as the face's does
    ((*_, nz, gap),) = corner((0.2, 0.3, -0.01), -1.0, DOWN)[:, 5:].tolist()
    assert (nz, gap) == (-1, 0.01)  # a ceiling's face: the body is below it
    assert corner((0.2, 0.3, 0.01), 1.0, NEITHER)[0, 6] == 0.01  # of a hollow: the corner tells


@pytest.mark.parametrize("height", [0.01, -0.01])
def test_edges_that_cross_touch_in_the_middle_between_them_with_the_normal_upwards(height):
    """A ridge along x from below and one along y from above."""
    lower = np.array([[-1.0, 0, 0], [1.0, 0, 0], [0, 1.0, -1], [0, -1.0, -1]])
    upper = np.array([[0, -1.0, height], [0, 1.0, height], [1.0, 0, 1], [-1.0, 0, 1]])
    ends, across = np.array([[0, 1]]), np.array([[2, 3]])
    (row,) = edges_across_edges(PAIR, upper, ends, across, lower, ends, across, 0.02, 0.02)
    assert row == pytest.approx([0, 0, height / 2, 0, 0, 1, height])
    assert len(edges_across_edges(PAIR, upper, ends, across, lower, ends, across, 0.005, 0.005)) == 0


def test_an_edge_over_the_bottom_of_a_groove_does_not_touch_its_edge():
    """The faces about the lower edge rise by far more than the slack, seen across it and not along it."""
    lower = np.array([[-9.0, 0, 0], [9.0, 0, 0], [9.0, 0.5, 0.2], [-9.0, -0.5, 0.2]])
    upper = np.array([[0, -1.0, 0.0], [0, 1.0, 0.0], [1.0, 0, 1], [-1.0, 0, 1]])
    ends, across = np.array([[0, 1]]), np.array([[2, 3]])
    assert len(edges_across_edges(PAIR, upper, ends, across, lower, ends, across, 0.02, 0.02)) == 0
