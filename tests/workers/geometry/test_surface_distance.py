"""Distances to a mesh, held against the plain search and against closed forms."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from workers.geometry.distance import distance_to_mesh, nearest_on_mesh


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


@pytest.mark.parametrize("faces", [1, 2, 5, 12])
def test_small_meshes_and_points_on_the_surface(faces):
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    mesh = Mesh(np.array(box.vertices), np.array(box.faces[:faces], np.int32))
    points = np.concatenate([mesh.vertices[mesh.faces].mean(axis=1), np.array([[0.0, 0.0, 9.0]])])
    distance, _ = distance_to_mesh(points, mesh)
    assert np.allclose(distance[:-1], 0.0, atol=1e-15)
    assert distance[-1] == pytest.approx(np.linalg.norm(nearest_on_mesh(points[-1:], mesh)[0] - points[-1:]))


def test_no_faces_are_infinitely_far():
    distance, face = distance_to_mesh(np.zeros((2, 3)), Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32)))
    assert np.isinf(distance).all() and (face == -1).all()
