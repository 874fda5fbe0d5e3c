"""Inward offsets of hulls, against closed forms and against Qhull's intersection of half-spaces."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull, HalfspaceIntersection

from schemas.base import frozen_array
from schemas.job.assets import ProceduralSource
from schemas.job.job import CATEGORIES
from schemas.scene.shape import Hull
from workers.assets.builtin.make import make_asset
from workers.geometry import hull_offset
from workers.geometry.hull import convex_hull
from workers.geometry.hull_offset import FEW, least_width_m, offset_hull

SOURCE = ProceduralSource(source="procedural")


def hull_of(category, index=0):
    return convex_hull(make_asset(category, SOURCE, index, 600.0).shape.vertices)


def reach(vertices, hull):
    return (vertices @ hull.normals.T).max(axis=0)


def rows(points):
    return sorted(tuple(row) for row in np.round(points, 12) + 0.0)


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (0.3, 0.05, 0.0005), (2.0, 0.001, 0.001)])
def test_a_box_loses_the_margin_on_every_side(sides):
    at = np.array([3.0, -2.0, 0.5])
    box = convex_hull(trimesh.creation.box(sides).vertices + at)
    smaller = offset_hull(box, 1e-4)
    assert smaller.offset_m == 1e-4
    expected = trimesh.creation.box(np.array(sides) - 2e-4).vertices + at
    assert rows(smaller.vertices) == rows(expected)


def test_an_octahedron_becomes_a_smaller_octahedron():
    """Its faces lie 1 / sqrt 3 from the middle, and six corners of four faces each stay six."""
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    smaller = offset_hull(convex_hull(corners), 0.01)
    assert rows(smaller.vertices) == rows(corners * (1.0 - 0.01 * np.sqrt(3.0)))


def test_faces_between_round_edges_may_vanish_and_the_others_stay():
    """A cube of side 2 whose edges are planed by 0.01: moved in by 0.1 it is the plain cube of side 1.8."""
    planed = 0.99
    points = [
        p for p in np.array(np.meshgrid(*[[-1, -planed, planed, 1]] * 3)).reshape(3, -1).T if (abs(p) == 1).sum() == 1
    ]
    smaller = offset_hull(convex_hull(np.array(points)), 0.1)
    assert rows(smaller.vertices) == rows(trimesh.creation.box((1.8, 1.8, 1.8)).vertices)


@pytest.mark.parametrize("by_m", [4e-5, 5e-4])
@pytest.mark.parametrize("category", CATEGORIES)
def test_the_smaller_body_is_the_one_that_qhull_finds(category, by_m):
    hull = hull_of(category, 1)
    smaller = offset_hull(hull, by_m)
    assert smaller.offset_m == by_m
    spaces = np.column_stack([hull.normals, by_m - reach(hull.vertices, hull)])
    exact = HalfspaceIntersection(spaces, hull.vertices.mean(axis=0)).intersections
    size = np.linalg.norm(np.ptp(hull.vertices, axis=0))
    assert (reach(smaller.vertices, hull) <= reach(hull.vertices, hull) - by_m + 1e-12 * size).all()
    merged = len(exact) > max(FEW, 2 * len(hull.vertices))
    assert ConvexHull(smaller.vertices).volume == pytest.approx(ConvexHull(exact).volume, rel=1e-5 if merged else 1e-10)
    assert len(smaller.vertices) <= max(FEW, 2 * len(hull.vertices))


@pytest.mark.parametrize(
    ("body", "by_m", "missed_m"),
    [
        (trimesh.creation.cylinder(0.01, 0.3, sections=360), 4e-5, 1e-13),
        (trimesh.creation.cylinder(0.0003, 0.1, sections=24), 4e-5, 1e-13),
        (trimesh.creation.box((0.2, 0.2, 0.0005)), 4e-5, 1e-13),
        (trimesh.creation.cone(0.05, 0.1, sections=360), 4e-5, 1e-13),
        (trimesh.creation.icosphere(2, 0.05), 4e-5, 1e-13),
        (trimesh.creation.icosphere(4, 0.05), 4e-5, 1e-8),
        (trimesh.creation.uv_sphere(0.05, count=[64, 64]), 4e-5, 1e-12),
    ],
)
def test_with_its_margin_the_smaller_body_touches_the_plane_of_every_face(body, by_m, missed_m):
    hull = convex_hull(np.asarray(body.vertices))
    smaller = offset_hull(hull, by_m)
    missed = reach(hull.vertices, hull) - reach(smaller.vertices, hull) - smaller.offset_m
    assert smaller.offset_m == by_m
    assert missed.min() >= -1e-13 and missed.max() <= missed_m
    assert len(smaller.vertices) <= max(FEW, 2 * len(hull.vertices))


@pytest.mark.parametrize("sides", [(0.2, 0.2, 0.0005), (0.2, 0.0003, 0.0003), (0.001, 0.001, 0.001)])
def test_half_of_a_body_is_left_however_large_the_margin(sides):
    hull = convex_hull(trimesh.creation.box(sides).vertices)
    smaller = offset_hull(hull, 0.04)
    assert smaller.offset_m == pytest.approx(min(sides) / 4, rel=1e-12)
    assert np.ptp(smaller.vertices, axis=0) == pytest.approx(np.array(sides) - min(sides) / 2, rel=1e-12)


def test_a_tetrahedron_does_not_vanish():
    """At a quarter of its height all its faces meet in one point."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 0.1
    hull = convex_hull(corners)
    smaller = offset_hull(hull, 1.0)
    assert smaller.offset_m == pytest.approx(0.75 * 0.1 / np.sqrt(3.0), rel=1e-9)
    assert rows(smaller.vertices) == rows(corners * 0.25)


def test_where_the_middle_of_the_vertices_is_no_place_to_stand_the_largest_ball_says_where():
    """Nearly all vertices of a long wedge lie on its curved blade."""
    along = np.linspace(0.0, 1.0, 200)
    blade = np.column_stack([1e-3 * np.sin(np.pi * along), np.zeros(200), along])
    base = np.array([[-0.1, y, z] for y in (-0.05, 0.05) for z in (0.0, 1.0)])
    hull = convex_hull(np.concatenate([blade, base]))
    smaller = offset_hull(hull, 5e-3)
    assert smaller.offset_m == 5e-3
    assert (reach(smaller.vertices, hull) <= reach(hull.vertices, hull) - 5e-3 + 1e-12).all()
    base_face = hull.normals[:, 0] < -0.999
    assert reach(smaller.vertices, hull)[base_face] == pytest.approx(0.1 - 5e-3, abs=1e-12)


@pytest.mark.parametrize("count", [4, 60])
def test_a_flat_sheet_stays_as_it_is(count):
    points = np.random.default_rng(2).random((count, 3)) * [0.2, 0.1, 0.0]
    hull = convex_hull(points)
    smaller = offset_hull(hull, 4e-5)
    assert smaller.offset_m == 0.0
    assert (smaller.vertices == hull.vertices).all()


def test_where_the_fast_hull_leaves_something_out_qhull_finds_it(monkeypatch):
    """With a pole dropped the body would reach too far."""
    hull = hull_of("can")
    expected = offset_hull(hull, 4e-5).vertices
    complete = hull_offset.manifold3d.Manifold.hull_points

    class Forgetful:
        """manifold3d that overlooks the plane under the can."""

        @staticmethod
        def hull_points(poles):
            return complete(np.delete(poles, np.argmin(poles[:, 2]), axis=0))

    monkeypatch.setattr(hull_offset.manifold3d, "Manifold", Forgetful)
    again = offset_hull(hull, 4e-5).vertices
    assert ConvexHull(again).volume == pytest.approx(ConvexHull(expected).volume, rel=1e-9)
    assert (reach(again, hull) <= reach(hull.vertices, hull) - 4e-5 + 1e-13).all()


def test_the_same_hull_gives_the_same_bits():
    hull = hull_of("bottle", 2)
    first = offset_hull(hull, 1e-4).vertices
    offset_hull(hull_of("mug"), 3e-4)
    copied = Hull(frozen_array(hull.vertices), frozen_array(hull.normals))
    assert offset_hull(copied, 1e-4).vertices.tobytes() == first.tobytes()


def test_the_least_width_of_a_plate_is_its_thickness():
    assert least_width_m(convex_hull(trimesh.creation.box((0.2, 0.3, 0.0005)).vertices)) == pytest.approx(
        5e-4, rel=1e-12
    )
    tilted = trimesh.creation.cylinder(0.004, 0.1, sections=360)
    tilted.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))
    assert least_width_m(convex_hull(np.asarray(tilted.vertices))) == pytest.approx(
        0.008 * np.cos(np.pi / 360), rel=1e-9
    )
