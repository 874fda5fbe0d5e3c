"""How an object stands: support margins and the turn onto a face, against closed forms."""

import math

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.kit.shapes import box
from workers.geometry.frames import DOWN, angle_between, pose, rotation_about, transform
from workers.geometry.hull import convex_hull
from workers.physics.support import snap_to_face, stands_on_face, support_margin

X = np.array([1.0, 0.0, 0.0])
CUBE = convex_hull(np.asarray(box(0.1, 0.1, 0.1).vertices))
GROUND = Mesh(np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]], np.int32))
CENTRE = np.zeros(3)


def test_the_margin_of_a_square_is_the_distance_to_its_nearest_side():
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2], [1, 1.0]])
    assert support_margin(square, np.array([1.2, 0.7])) == pytest.approx(0.7)
    assert support_margin(square, np.array([2.5, 1.0])) == pytest.approx(-0.5)


@pytest.mark.parametrize("contacts", [np.zeros((0, 2)), np.array([[1.0, 0]]), np.array([[-1, 0], [0, 0], [2, 0.0]])])
def test_no_margin_is_left_on_fewer_than_three_points_or_on_a_line(contacts):
    assert support_margin(contacts, np.array([0.3, 0.0])) <= 0


@pytest.mark.parametrize("tilt", [0.0, 0.001, -0.01, 0.019])
def test_a_slightly_tilted_cube_is_turned_flat_about_its_centre(tilt):
    T = pose(rotation_about(X, tilt), np.array([0.3, 0.2, 0.9]))
    snapped = snap_to_face(T, CUBE, CENTRE)
    assert snapped is not None
    low = transform(snapped, CUBE.vertices)[:, 2]
    assert np.sort(low)[:4] == pytest.approx(0.85, abs=1e-12)
    assert snapped[:3, 3] == pytest.approx(T[:3, 3], abs=1e-15)
    assert angle_between(T[:3, :3], snapped[:3, :3]) == pytest.approx(abs(tilt), abs=1e-12)


def test_a_cube_that_leans_far_stands_on_no_face():
    assert snap_to_face(pose(rotation_about(X, 0.05), np.zeros(3)), CUBE, CENTRE) is None


def test_a_face_without_the_centre_of_mass_over_it_is_not_chosen():
    slab = convex_hull(np.asarray(trimesh.creation.box((0.1, 0.1, 0.3)).vertices))
    com = np.array([0.08, 0.0, 0.0])  # beyond the small face's side at 0.05
    T = pose(np.eye(3), np.zeros(3))
    assert snap_to_face(T, slab, com) is None
    assert snap_to_face(T, slab, np.array([0.04, 0.0, 0.0])) == pytest.approx(T)


def test_a_hull_has_outward_unit_normals_and_only_its_corners():
    rng = np.random.default_rng(0)
    cloud = np.concatenate([np.asarray(box(0.2, 0.1, 0.3).vertices), rng.uniform(-0.04, 0.04, (100, 3))])
    hull = convex_hull(cloud)
    assert len(hull.vertices) == 8
    assert np.linalg.norm(hull.normals, axis=1) == pytest.approx(1.0)
    assert {tuple(n) for n in np.round(hull.normals).astype(int)} == {
        (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1),
    }  # fmt: skip


def test_a_flat_cloud_has_a_hull_too():
    sheet = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0.0]])
    assert len(convex_hull(sheet).vertices) >= 4


def test_a_cube_stands_on_its_face_and_not_on_its_edge():
    assert stands_on_face(CUBE.vertices, DOWN)
    assert not stands_on_face(CUBE.vertices, rotation_about(X, 0.3) @ DOWN)


def test_on_a_line_or_a_point_the_margin_is_minus_the_distance_to_it():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    assert support_margin(square, np.array([1.3, 1.4])) == pytest.approx(-0.5)
    assert support_margin(square[:2], np.array([-1.2, 0.3])) == pytest.approx(-math.hypot(1.2, 0.3))
    assert support_margin(square[:1], np.array([-1.0, -1.5])) == pytest.approx(-math.hypot(1.0, 1.5))
    assert support_margin(np.empty((0, 2)), np.zeros(2)) == -np.inf
