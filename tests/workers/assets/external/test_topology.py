"""Merging points, winding, bodies: against trimesh and by hand."""

import numpy as np
import pytest
import trimesh

from workers.assets.external.mesh import find_bodies, find_collapsed, find_flips, find_repeated, is_solid, merge_points


def soup(mesh):
    """Every face with corners of its own."""
    return mesh.vertices[mesh.faces.ravel()], np.arange(3 * len(mesh.faces)).reshape(-1, 3)


def test_points_at_one_place_get_one_number_and_others_do_not():
    vertices, _ = soup(trimesh.creation.icosphere(2))
    assert len(np.unique(merge_points(vertices))) == 162
    assert len(np.unique(merge_points(np.array([[0.0, 0, 0], [1e-10, 0, 0], [1e-4, 0, 0], [1, 1, 1]])))) == 3


def test_a_collapsed_face_and_a_doubled_face_are_found():
    faces = np.array([[0, 1, 2], [1, 2, 0], [2, 1, 0], [3, 3, 1], [0, 1, 3]])
    assert find_collapsed(faces).tolist() == [False, False, False, True, False]
    assert find_repeated(faces, oriented=True).tolist() == [False, True, False, False, False]
    assert find_repeated(faces, oriented=False).tolist() == [False, True, True, False, False]


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_turning_the_faces_that_disagree_makes_a_sphere_consistent_with_the_fewest_flips(share):
    mesh = trimesh.creation.icosphere(3)
    wrong = np.random.default_rng(0).random(len(mesh.faces)) < share
    faces = np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces)
    assert find_flips(faces).tolist() == wrong.tolist()


def test_a_moebius_strip_is_left_alone():
    n = 20
    lower, upper = np.arange(n), np.arange(n, 2 * n)
    nxt_lower, nxt_upper = np.append(lower[1:], upper[0]), np.append(upper[1:], lower[0])
    faces = np.concatenate([np.stack([lower, nxt_lower, nxt_upper], 1), np.stack([lower, nxt_upper, upper], 1)])
    assert not find_flips(faces).any()


def test_bodies_are_told_apart_with_the_volume_of_each():
    one, two = trimesh.creation.box((1, 2, 3)), trimesh.creation.icosphere(3, 0.5)
    two.apply_translation((5, 0, 0))
    sheet = trimesh.Trimesh([[9, 0, 0], [9, 1, 0], [9, 0, 1]], [[0, 1, 2]], process=False)
    whole = trimesh.util.concatenate([one, two, sheet])
    bodies = find_bodies(whole.vertices, whole.faces, whole.faces)
    assert bodies.closed.tolist() == [True, True, False]
    assert bodies.volume[:2] == pytest.approx([one.volume, two.volume], rel=1e-12)
    assert np.bincount(bodies.body).tolist() == [12, len(two.faces), 1]


def test_only_a_closed_and_consistent_mesh_with_volume_is_solid():
    mesh = trimesh.creation.icosphere(2)
    vertices, faces = soup(mesh)
    assert is_solid(vertices, faces)
    assert not is_solid(vertices, faces[1:])
    turned = faces.copy()
    turned[0] = turned[0, ::-1]
    assert not is_solid(vertices, turned)
    assert not is_solid(vertices, faces[:, ::-1])  # inside out
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert not is_solid(flat, np.array([[0, 1, 2], [2, 1, 0]]))  # closed, but two sides of nothing
