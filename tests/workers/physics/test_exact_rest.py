"""One step of bodies from rest, and the forces in balance, against what can be worked out by hand.

Bodies that are followed until nothing moves, against poses that can be worked out by hand.
"""

import math

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.kit.contacts import UP, box, contacts_between, mesh_of, thing_of, tipped
from workers.geometry.frames import pose, rotation_about, transform, translation, uniform_rotation
from workers.physics import exact_rest as module
from workers.physics.contact_surface import surface_of
from workers.physics.exact_rest import MANY, Motion, Rested, rest, step

WITHIN_M = 5e-5
FALL_M = 1e-4
G = 9.81
GROUND = box((1.0, 1.0, 0.1), (0, 0, -0.05))


def follow(
    bodies: list[Mesh], ground: Mesh = GROUND, friction: float = 0.5, masses=None, fall_m: float = FALL_M
) -> Motion:
    masses = masses or [1.0] * len(bodies)
    inertias = [thing_of(mesh, mass).inertia(np.eye(4)) for mesh, mass in zip(bodies, masses, strict=True)]
    return step(inertias, contacts_between([*bodies, ground], WITHIN_M), friction, -fall_m * UP, G)


def moved(motion: Motion) -> float:
    """As a share of free fall."""
    return float(max(np.abs(motion.moves).max(), np.abs(motion.turns).max())) / FALL_M


def test_at_rest_forces_balance_every_weight():
    bodies = [box((0.1, 0.1, 0.1), (0, 0, 0.05)), box((0.05, 0.05, 0.05), (0.01, 0, 0.125))]
    contacts = contacts_between([*bodies, GROUND], WITHIN_M)
    motion = follow(bodies, masses=[2.0, 3.0])
    assert moved(motion) < 1e-9
    table = contacts.lower == 2
    assert motion.forces[table].sum(axis=0) == pytest.approx([0, 0, 5 * G], abs=1e-9)
    assert motion.forces[~table].sum(axis=0) == pytest.approx([0, 0, -3 * G], abs=1e-9)  # on the lower one


@pytest.mark.parametrize(("angle", "stands"), [(0.0, True), (0.46, True), (0.4637, False), (0.6, False)])
def test_a_box_stands_on_a_slope_up_to_the_angle_of_friction(angle, stands):
    """tan 0.4636 = 0.5."""
    turn = tipped(angle)
    slope = mesh_of(trimesh.creation.box((1.0, 1.0, 0.1)), pose(turn, -0.05 * turn[:, 2]))
    motion = follow([box((0.1, 0.1, 0.04), 0.02 * turn[:, 2], turn)], slope)
    if stands:
        assert moved(motion) < 1e-9
    else:  # down the slope, by what the cone does not hold
        assert motion.moves[0] @ turn[:, 0] > 0.5 * FALL_M * (np.sin(angle) - 0.5 * np.cos(angle)) * 0.99


@pytest.mark.parametrize(("friction", "stands"), [(0.30, True), (0.26, False)])
def test_a_ladder_against_a_wall_needs_its_friction(friction, stands):
    """With friction m at floor and wall alike it holds up to tan a = 2 m / (1 - m^2) from the vertical; here a = 0.55:
    m = tan(a / 2) = 0.2822."""
    ladder = box((0.01, 0.3, 2.0), turn=tipped(0.55))
    low, high = ladder.vertices.min(axis=0), ladder.vertices.max(axis=0)
    floor = trimesh.creation.box((9.0, 9.0, 1.0)).apply_translation((0, 0, low[2] - 0.5))
    wall = trimesh.creation.box((1.0, 9.0, 8.0)).apply_translation((high[0] + 0.5, 0, low[2] + 4.0))
    motion = follow([ladder], mesh_of(trimesh.util.concatenate([floor, wall])), friction)
    assert moved(motion) < 1e-9 if stands else moved(motion) > 1e-3


def test_energy_is_never_gained_where_nothing_overlaps():
    """The heights' sum, weighted by mass, sinks in every direction that a leaning box may go."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        turn = rotation_about(UP, rng.uniform(0, 6)) @ tipped(rng.uniform(0.01, 0.4))
        cube = box((0.1, 0.08, 0.05), turn=turn)
        cube = Mesh(cube.vertices - [0, 0, cube.vertices[:, 2].min()], cube.faces)
        assert follow([cube]).moves[0, 2] < 0.0


def columns(count: int) -> list[Mesh]:
    """Boxes in columns of five, turned at random about the vertical, with 20 micrometres below each but the lowest."""
    rng, bodies = np.random.default_rng(7), []
    for number in range(count):
        turn = rotation_about(UP, rng.uniform(0, 6))
        at = 0.09 * (number // 5), rng.uniform(-0.005, 0.005), 0.025 + 0.05002 * (number % 5)
        bodies.append(box((0.06, 0.06, 0.05), at, turn))
    return bodies


@pytest.mark.parametrize("fall_m", [1e-4, 1e-2])
def test_the_two_solvers_agree(fall_m, monkeypatch):
    """DAQP and Clarabel share no code: an active set and an interior point."""
    bodies, both = columns(MANY), []
    for least in (MANY, MANY + 1):
        monkeypatch.setattr(module, "MANY", least)
        both.append(follow(bodies, fall_m=fall_m))
    assert both[0].moves == pytest.approx(both[1].moves, abs=1e-7 * fall_m)
    assert both[0].turns == pytest.approx(both[1].turns, abs=1e-6 * fall_m)
    assert np.abs(both[0].moves).max() > 0.1 * FALL_M and not np.array_equal(both[0].moves, both[1].moves)


FRICTION = 0.49
CUBE = box((0.1, 0.1, 0.1))


def settle(meshes: list[Mesh], poses, ground: Mesh = GROUND, masses=None) -> Rested:
    masses = masses or [1.0] * len(meshes)
    things = [thing_of(mesh, mass) for mesh, mass in zip(meshes, masses, strict=True)]
    return rest(things, poses, surface_of(ground, True), FRICTION)


def test_what_rests_is_left_to_the_bit():
    T = translation(0.0, 0.0, 0.05)
    found = settle([CUBE], [T])
    assert found.steps == 0 and found.poses[0].tobytes() == T.tobytes()


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
