"""The nearest point of a surface, against trimesh and by hand.

Distances to a mesh, held against the plain search and against closed forms.
"""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from workers.geometry.distance import distance_to_mesh, nearest_on_mesh, nearest_on_segments


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


@pytest.mark.parametrize("seed", range(3))
def test_distances_are_those_of_the_plain_search(seed):
    rng = np.random.default_rng(seed)
    knot = trimesh.creation.torus(0.1, 0.03, major_sections=30, minor_sections=12)
    mesh = Mesh(np.array(knot.vertices), np.array(knot.faces, np.int32))
    points = rng.normal(0, 0.1, (300, 3))
    distance, face = distance_to_mesh(points, mesh)
    near, _ = nearest_on_mesh(points, mesh)
    assert np.allclose(distance, np.linalg.norm(near - points, axis=1), atol=1e-12)
    on_face, _ = nearest_on_mesh(points[:1], Mesh(mesh.vertices, mesh.faces[face[:1]]))
    assert np.linalg.norm(on_face - points[:1]) == pytest.approx(distance[0])
