"""Convex hulls, against Qhull and closed forms."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from schemas.job.assets import CATEGORIES, ProceduralSource
from workers.assets.builtin.make import make_asset
from workers.geometry.hull import MOST_VERTICES, convex_hull, depth_m, least_width_m

SOURCE = ProceduralSource(source="procedural")


def farthest_outside(points, hull):
    """Metres that a point lies beyond the plane of a face of the hull, at most."""
    support = (hull.vertices @ hull.normals.T).max(axis=0)
    return float((points @ hull.normals.T - support).max())


@pytest.mark.parametrize("category", [*CATEGORIES, "table"])
def test_the_hull_of_a_shape_is_the_one_that_qhull_finds(category):
    for index in range(5):
        points = make_asset(category, SOURCE, index, 600.0).shape.vertices
        hull, qhull = convex_hull(points), ConvexHull(points)
        assert ConvexHull(hull.vertices).volume == pytest.approx(qhull.volume, rel=1e-12)
        assert {tuple(p) for p in hull.vertices} <= {tuple(p) for p in points}
        assert farthest_outside(points, hull) < 1e-7 * 0.25, "1e-7 of its size"
        assert np.linalg.norm(hull.normals, axis=1) == pytest.approx(np.ones(len(hull.normals)))
        # Every direction of a face is one that Qhull has, and the other way round.
        agreement = hull.normals @ qhull.equations[:, :3].T
        assert agreement.max(axis=1).min() > 1.0 - 1e-9
        areas = np.linalg.norm(
            np.cross(*(points[qhull.simplices[:, k]] - points[qhull.simplices[:, 0]] for k in (1, 2))), axis=1
        )
        assert agreement.max(axis=0)[areas > 1e-9].min() > 1.0 - 1e-9


def test_points_that_come_often_and_points_within_change_nothing():
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
    within = np.random.default_rng(0).uniform(0.1, 0.9, (500, 3))
    hull = convex_hull(np.concatenate([within, corners, corners, within]))
    assert {tuple(p) for p in hull.vertices} == {tuple(p) for p in corners}
    assert {tuple(n) for n in np.round(hull.normals, 12) + 0.0} == {
        tuple(sign * axis) for axis in np.eye(3) + 0.0 for sign in (1.0, -1.0)
    }


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_repeated_points_change_no_bit_of_a_hull(scale):
    lattice = np.stack(np.meshgrid(*[np.arange(-4.0, 5.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * scale
    ball = lattice[np.linalg.norm(lattice, axis=1) < 4.3 * scale]
    shuffled = np.random.default_rng(4).permutation(np.repeat(ball, 3, axis=0))
    once, often = convex_hull(ball), convex_hull(np.concatenate([ball, shuffled]))
    assert np.array_equal(once.vertices, often.vertices)
    assert np.array_equal(once.normals, often.normals)


@pytest.mark.parametrize("thick", [0.0, 1e-8, 1e-6, 1e-5, 1e-3])
def test_a_thin_sheet_keeps_its_thickness(thick):
    points = np.random.default_rng(1).random((200, 3)) * [1.0, 1.0, thick]
    hull = convex_hull(points)
    assert len(hull.vertices) >= 4
    assert np.ptp(hull.vertices[:, 2]) == pytest.approx(thick, rel=0.2, abs=1e-12)
    assert farthest_outside(points, hull) < 1e-9 + 1e-7 * thick


def test_a_hull_with_too_many_vertices_is_made_coarser_by_little():
    """PyBullet fails beyond 131,072. An ellipsoid, every point of which is on its hull."""
    points = np.random.default_rng(2).normal(size=(150_000, 3))
    points *= np.array([0.2, 0.1, 0.15]) / np.linalg.norm(points, axis=1)[:, None]
    hull = convex_hull(points)
    assert 1000 < len(hull.vertices) <= MOST_VERTICES
    assert {tuple(p) for p in hull.vertices} <= {tuple(p) for p in points}
    directions = np.random.default_rng(3).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    out = (points @ directions.T).max(axis=0) - (hull.vertices @ directions.T).max(axis=0)
    assert 0.0 <= out.max() < 2e-4 * 0.54


def test_the_least_width_of_a_plate_is_its_thickness():
    assert least_width_m(convex_hull(trimesh.creation.box((0.2, 0.3, 0.0005)).vertices)) == pytest.approx(
        5e-4, rel=1e-12
    )
    tilted = trimesh.creation.cylinder(0.004, 0.1, sections=360)
    tilted.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))
    assert least_width_m(convex_hull(np.asarray(tilted.vertices))) == pytest.approx(
        0.008 * np.cos(np.pi / 360), rel=1e-9
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_least_width_is_over_all_faces(seed):
    hull = convex_hull(np.random.default_rng(seed).normal(size=(200, 3)) * [0.3, 0.2, 0.1])
    along = hull.vertices @ hull.normals.T
    assert least_width_m(hull) == pytest.approx((along.max(axis=0) - along.min(axis=0)).min(), rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_the_depth_of_a_point_in_a_hull_is_its_least_distance_from_a_plane_of_a_face(seed):
    rng = np.random.default_rng(seed)
    hull = convex_hull(rng.standard_normal((200, 3)))
    qhull = ConvexHull(hull.vertices)
    point = 0.3 * rng.standard_normal(3)
    expected = -(qhull.equations[:, :3] @ point + qhull.equations[:, 3]).max()
    assert depth_m(hull.vertices - point, hull.normals) == pytest.approx(expected, rel=1e-12)
