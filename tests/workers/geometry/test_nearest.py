"""The nearest point of a surface, against trimesh and by hand."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from workers.geometry.distance import nearest_on_mesh, nearest_on_segments


def test_the_nearest_point_is_the_one_that_trimesh_finds():
    body = trimesh.creation.torus(0.05, 0.02, major_sections=12, minor_sections=7)
    points = np.random.default_rng(0).normal(size=(400, 3)) * 0.05
    found, faces = nearest_on_mesh(points, Mesh(np.asarray(body.vertices), np.asarray(body.faces, dtype=np.int32)))
    pairs = np.repeat(points, len(body.faces), axis=0)
    nearest = trimesh.triangles.closest_point(np.tile(body.triangles, (len(points), 1, 1)), pairs)
    expected = np.linalg.norm(nearest - pairs, axis=1).reshape(len(points), -1).min(axis=1)
    assert np.linalg.norm(found - points, axis=1) == pytest.approx(expected, abs=1e-12)
    on_plane = ((found - body.triangles[faces][:, 0]) * body.face_normals[faces]).sum(axis=1)
    assert np.abs(on_plane).max() < 1e-12


def test_nothing_is_found_beyond_the_limit():
    triangle = Mesh(
        np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], dtype=np.float64), np.array([(0, 1, 2)], dtype=np.int32)
    )
    found, faces = nearest_on_mesh(np.array([(0.2, 0.2, 0.1), (0.2, 0.2, 0.1001)]), triangle, within_m=0.1)
    assert faces.tolist() == [0, -1]
    assert found[0] == pytest.approx([0.2, 0.2, 0.0])
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize(
    "corners", [[(0, 0, 0)] * 3, [(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 0, 0), (0, 0, 0), (2, 0, 0)]]
)
def test_a_triangle_without_area_is_a_line_or_a_point(corners):
    flat = Mesh(np.array(corners, dtype=np.float64), np.array([(0, 1, 2)], dtype=np.int32))
    found, _ = nearest_on_mesh(np.array([(1.5, 1.0, 0.0)]), flat)
    assert found[0] == pytest.approx([min(1.5, max(c[0] for c in corners)), 0.0, 0.0])


def test_the_nearest_points_of_two_segments_are_as_near_as_any_of_many():
    """Against all pairs of 400 points of each; and parallel segments and points as segments, in closed form."""
    chance, here, there = np.random.default_rng(5), np.empty(3), np.empty(3)
    share = np.linspace(0.0, 1.0, 400)[:, None]
    for _ in range(200):
        a, b, c, d = chance.uniform(-1.0, 1.0, (4, 3))
        nearest_on_segments(a, b, c, d, here, there)
        points, others = a + share * (b - a), c + share * (d - c)
        least = np.linalg.norm(points[:, None] - others[None], axis=2).min()
        assert least - 0.004 < np.linalg.norm(there - here) <= least + 1e-12
        assert np.linalg.norm(np.cross(here - a, b - a)) < 1e-12
        assert np.linalg.norm(np.cross(there - c, d - c)) < 1e-12
    x, y = np.eye(3)[:2]
    for a, b, c, d, far in (
        (0 * x, x, y, x + y, 1.0),
        (0 * x, x, 3 * x, 2 * x, 1.0),
        (0 * x, 0 * x, y, y, 1.0),
        (0 * x, 0 * x, y - x, y + x, 1.0),
        (y - x, y + x, 0 * x, 0 * x, 1.0),
    ):
        nearest_on_segments(a, b, c, d, here, there)
        assert np.linalg.norm(there - here) == pytest.approx(far)
