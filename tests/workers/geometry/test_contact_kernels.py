"""Compiled loops over features: one point over one face, and one edge across another."""

import numpy as np

from workers.geometry.contact_kernels import find_edge_crossings, find_near_faces

FACE = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])


def test_points_within_the_distance_of_a_face_are_paired_with_it():
    points = np.array([[0.2, 0.2, 0.01], [0.2, 0.2, 0.03], [0.9, 0.9, 0.01]])
    assert find_near_faces(points, FACE, FACE.min(axis=1), FACE.max(axis=1), 0.02).tolist() == [[0, 0]]


def test_crossing_edges_touch_in_the_middle_between_them_with_the_normal_upwards():
    """A ridge along x from below and one along y from above, a hundredth apart."""
    lower, upper = np.array([[[-1.0, 0, 0], [1.0, 0, 0]]]), np.array([[[0, -1.0, 0.01], [0, 1.0, 0.01]]])
    below, above = np.array([[[0, 1.0, -1], [0, -1.0, -1]]]), np.array([[[1.0, 0, 1], [-1.0, 0, 1]]])
    ((middle, normal),) = find_edge_crossings(upper, above, lower, below, 0.02)
    assert np.allclose(middle, [0, 0, 0.005]) and np.allclose(normal, [0, 0, 1])
    assert len(find_edge_crossings(upper, above, lower, below, 0.005)) == 0
