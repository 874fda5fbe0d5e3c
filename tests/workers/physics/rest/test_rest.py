"""Bodies that are followed until nothing moves, against poses that can be worked out by hand."""

import math

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.kit.contacts import UP, box, contacts_between, mesh_of, thing_of, tipped
from workers.geometry.frames import pose, rotation_about, transform, translation, uniform_rotation
from workers.physics.contact_surface import surface_of
from workers.physics.exact_rest import Rested, rest

FRICTION = 0.49
GROUND = box((1.0, 1.0, 0.1), (0, 0, -0.05))
CUBE = box((0.1, 0.1, 0.1))


def settle(meshes: list[Mesh], poses, ground: Mesh = GROUND, masses=None) -> Rested:
    masses = masses or [1.0] * len(meshes)
    things = [thing_of(mesh, mass) for mesh, mass in zip(meshes, masses, strict=True)]
    return rest(things, poses, surface_of(ground, True), FRICTION)


@pytest.mark.parametrize("gap_m", [2e-3, 3e-4, 1e-6, -1e-6, -3e-4, -2e-3])
def test_a_box_comes_down_or_up_to_touch(gap_m):
    found = settle([CUBE], [translation(0.1, 0.2, 0.05 + gap_m)])
    assert found.still
    assert found.poses[0] == pytest.approx(translation(0.1, 0.2, 0.05), abs=1e-9)


def test_what_rests_is_left_to_the_bit():
    T = translation(0.0, 0.0, 0.05)
    found = settle([CUBE], [T])
    assert found.steps == 0 and found.poses[0].tobytes() == T.tobytes()


@pytest.mark.parametrize("lean", [0.002, -0.01])
def test_what_leans_a_little_tips_onto_its_face(lean):
    T = pose(tipped(lean), np.array([0.0, 0.0, 0.0505]))
    found = settle([CUBE], [T])
    assert found.still
    assert found.poses[0][:3, :3] == pytest.approx(np.eye(3), abs=1e-8)
    assert found.poses[0][2, 3] == pytest.approx(0.05, abs=1e-9)


def test_a_prism_on_a_ridge_rolls_onto_the_side_that_it_leans_over():
    prism = mesh_of(trimesh.creation.cylinder(0.05, 0.2, sections=32))
    lying = rotation_about(np.array([1.0, 0.0, 0.0]), math.pi / 2)
    T = pose(rotation_about(np.array([0.0, 1.0, 0.0]), 0.01) @ lying, np.array([0.0, 0.0, 0.05]))
    found = settle([prism], [T])
    assert found.still
    assert found.poses[0][2, 3] == pytest.approx(0.05 * math.cos(math.pi / 32), abs=1e-8)


def test_what_is_balanced_on_an_edge_is_not_at_rest():
    """A prism exactly on a ridge: in balance, and gone at a breath."""
    prism = mesh_of(trimesh.creation.cylinder(0.05, 0.2, sections=32))
    lying = pose(rotation_about(np.array([1.0, 0.0, 0.0]), math.pi / 2), np.array([0.0, 0.0, 0.05]))
    low = transform(lying, prism.vertices)[:, 2].min()
    found = settle([prism], [translation(0.0, 0.0, -low) @ lying])
    assert found.still
    assert found.poses[0][2, 3] == pytest.approx(0.05 * math.cos(math.pi / 32), abs=1e-8)


def test_three_that_overlap_or_hover_come_to_a_stack():
    """By tenths of a millimetre, each turned, the second 20 times as heavy."""
    at = []
    for k, off_m in enumerate((-2e-4, 3e-4, -1e-4)):
        turn = rotation_about(UP, 0.3 * k) @ tipped(1e-3 * (k - 1))
        at.append(pose(turn, np.array([0.01 * k, 0.0, 0.05 + 0.1 * k + off_m])))
    found = settle([CUBE] * 3, at, masses=[1.0, 20.0, 1.0])
    assert found.still
    for k, T in enumerate(found.poses):
        assert T[2, 3] == pytest.approx(0.05 + 0.1 * k, abs=1e-8)
        assert T[2, :3] == pytest.approx(UP, abs=1e-7)
    placed = [Mesh(transform(T, CUBE.vertices), CUBE.faces) for T in found.poses]
    assert np.abs(contacts_between([*placed, GROUND], 1e-5).gaps).max() < 1e-8


def test_a_ball_in_a_bowl_sinks_to_its_bottom():
    """From 0.3 mm above, off the middle by less than a facet."""
    ball = mesh_of(trimesh.creation.icosphere(4, 0.02))
    outer = trimesh.creation.icosphere(5, 0.05)
    bowl = trimesh.boolean.difference(
        [trimesh.creation.box((0.14, 0.14, 0.06)).apply_translation((0, 0, -0.03)), outer]
    )
    found = settle([ball], [translation(0.0005, 0.0, -0.0297)], mesh_of(bowl))
    assert found.still
    assert found.poses[0][2, 3] == pytest.approx(-0.03, abs=1e-4)  # but for the facets
    sunk = Mesh(transform(found.poses[0], ball.vertices), ball.faces)
    assert contacts_between([sunk, mesh_of(bowl)], 1e-5).gaps.min() == pytest.approx(0.0, abs=1e-8)


def test_what_is_far_from_rest_is_said_not_to_rest():
    edge = pose(tipped(0.6), np.array([0.0, 0.0, 0.0]))
    low = transform(edge, CUBE.vertices)[:, 2].min()
    found = settle([CUBE], [translation(0, 0, -low) @ edge])
    assert not found.still
    assert abs(np.arcsin(found.poses[0][0, 2])) < 0.6  # it has begun to tip


def test_what_is_jammed_is_said_not_to_rest():
    walls = [trimesh.creation.box((0.1, 1.0, 1.0)).apply_translation((x, 0, 0)) for x in (-0.1 + 2e-5, 0.1 - 2e-5)]
    assert not settle([CUBE], [np.eye(4)], mesh_of(trimesh.util.concatenate(walls))).still


@pytest.mark.parametrize("seed", range(8))
def test_any_polyhedron_let_go_near_a_face_comes_to_stand_on_it_without_a_gap(seed):
    """A random hull on the face over which its centre of mass is lowest, which is stable; lifted and tilted."""
    rng = np.random.default_rng(seed)
    hull = trimesh.convex.convex_hull(rng.normal(size=(30, 3)) * [0.03, 0.04, 0.02])
    heights = (hull.vertices @ hull.face_normals.T).max(axis=0) - hull.face_normals @ hull.center_mass
    R = trimesh.geometry.align_vectors(hull.face_normals[np.argmin(heights)], -UP)[:3, :3]
    turned = rotation_about(np.array([1.0, 0.0, 0.0]), 0.004) @ R
    low = (hull.vertices @ turned.T)[:, 2].min()
    found = settle([mesh_of(hull)], [pose(turned, np.array([0, 0, 2e-4 - low]))])
    assert found.still
    heights = transform(found.poses[0], np.asarray(hull.vertices))[:, 2]
    assert np.sort(heights)[:3] == pytest.approx(0.0, abs=1e-8)


def test_the_same_bodies_come_to_the_same_bits():
    rng = np.random.default_rng(1)
    at = [pose(uniform_rotation(rng), np.array([0.0, 0.0, 0.09])), translation(0.3, 0.0, 0.0503)]
    one, other = (settle([CUBE] * 2, at) for _ in range(2))
    assert [T.tobytes() for T in one.poses] == [T.tobytes() for T in other.poses]
    assert one.steps == other.steps
