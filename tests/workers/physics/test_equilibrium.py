"""Contacts and static equilibrium, against what can be worked out by hand."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from workers.geometry.contact_points import find_contact_points
from workers.geometry.frames import pose, rotation_about, transform
from workers.physics.equilibrium import (
    FIXED,
    Contact,
    Weight,
    equilibrium_residual,
    support_margin_m,
)

WITHIN_M = 5e-5
UP = np.array([0.0, 0.0, 1.0])


def mesh_of(body, T=None):
    vertices = np.asarray(body.vertices, dtype=np.float64)
    return Mesh(vertices if T is None else transform(T, vertices), np.asarray(body.faces, dtype=np.int32))


def box(sides, at=(0.0, 0.0, 0.0), turn=None):
    T = pose(np.eye(3) if turn is None else turn, np.array(at, dtype=np.float64))
    return mesh_of(trimesh.creation.box(sides), T)


def tipped(angle_rad):
    """About the y axis: the side that looks to +x sinks."""
    return rotation_about(np.array([0.0, 1.0, 0.0]), angle_rad)


def rest(upper, lower, com, size_m, friction=0.5):
    points, normals = find_contact_points(upper, lower, WITHIN_M)
    contact = Contact(0, FIXED, points, normals)
    return float(equilibrium_residual([Weight(1.0, np.array(com), size_m)], [contact], friction)[0])


GROUND = box((1.0, 1.0, 0.1), (0, 0, -0.05))


def test_a_box_on_a_level_touches_it_with_four_corners():
    points, normals = find_contact_points(box((0.1, 0.2, 0.3), (0, 0, 0.15)), GROUND, WITHIN_M)
    assert {tuple(p) for p in np.round(points, 9) + 0.0} == {(x, y, 0.0) for x in (-0.05, 0.05) for y in (-0.1, 0.1)}
    assert normals == pytest.approx(np.tile(UP, (len(points), 1)), abs=1e-12)
    assert rest(box((0.1, 0.2, 0.3), (0, 0, 0.15)), GROUND, (0, 0, 0.15), 0.37) < 1e-9


def test_nothing_touches_beyond_the_distance():
    for gap_m, count in ((4e-5, 4), (6e-5, 0), (-4e-5, 4), (-6e-5, 0)):
        points, _ = find_contact_points(box((0.1, 0.1, 0.1), (0, 0, 0.05 + gap_m)), GROUND, WITHIN_M)
        assert len(points) == count
    assert rest(box((0.1, 0.1, 0.1), (0, 0, 0.06)), GROUND, (0, 0, 0.06), 0.1) == 1.0


def test_the_way_faces_are_wound_does_not_turn_normals():
    upper = box((0.1, 0.1, 0.1), (0.47, 0, 0.05))
    inside_out = Mesh(GROUND.vertices, np.ascontiguousarray(GROUND.faces[:, ::-1]))
    for lower in (GROUND, inside_out):
        for top in (upper, Mesh(upper.vertices, np.ascontiguousarray(upper.faces[:, ::-1]))):
            points, normals = find_contact_points(top, lower, WITHIN_M)
            assert len(points) >= 4
            assert normals == pytest.approx(np.tile(UP, (len(points), 1)), abs=1e-9)


def test_over_the_edge_of_a_table_edges_touch_where_they_cross():
    """And a corner that lies on the edge touches the top, not the side."""
    points, normals = find_contact_points(box((0.1, 0.1, 0.1), (0.48, 0, 0.05)), GROUND, WITHIN_M)
    assert points[:, 0].max() == pytest.approx(0.5)
    assert normals == pytest.approx(np.tile(UP, (len(points), 1)), abs=1e-9)
    flush, normals = find_contact_points(box((0.1, 0.1, 0.1), (0.45, 0, 0.05)), GROUND, WITHIN_M)
    assert flush[:, 0].max() == pytest.approx(0.5)
    assert normals == pytest.approx(np.tile(UP, (len(flush), 1)), abs=1e-9)


@pytest.mark.parametrize("over_m", [-0.001, 0.001, 0.01])
def test_beyond_the_edge_what_is_missing_is_the_moment_of_the_overhang(over_m):
    """Forces f up at the edge, at lever x = over / size from the middle: least of (1 - f)^2 + (f x)^2 is f = 1 / (1 + x^2)."""
    size = 0.2
    upper = box((0.1, 0.1, 0.1), (0.5 + over_m, 0, 0.05))
    residual = rest(upper, GROUND, (0.5 + over_m, 0, 0.05), size, friction=0.0)
    x = max(over_m, 0.0) / size
    assert residual == pytest.approx(max(x / (1 + x * x), x * x / (1 + x * x)), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("angle", "stands"), [(0.0, True), (0.46, True), (0.4637, False), (0.6, False)])
def test_a_box_stands_on_a_slope_up_to_the_angle_of_friction(angle, stands):
    """tan 0.4636 = 0.5. Beyond it, what is missing is the sine between the weight and the cone."""
    turn = tipped(angle)
    slope = mesh_of(trimesh.creation.box((1.0, 1.0, 0.1)), pose(turn, -0.05 * turn[:, 2]))
    at = 0.02 * turn[:, 2]
    points, normals = find_contact_points(box((0.1, 0.1, 0.04), at, turn), slope, WITHIN_M)
    assert normals == pytest.approx(np.tile(turn[:, 2], (len(points), 1)), abs=1e-9)
    residual = equilibrium_residual([Weight(1.0, at, 10.0)], [Contact(0, FIXED, points, normals)], 0.5)[0]
    assert residual == pytest.approx(0.0 if stands else np.sin(angle - np.arctan(0.5)), rel=0.01, abs=1e-9)


@pytest.mark.parametrize(("friction", "stands"), [(0.30, True), (0.26, False)])
def test_a_ladder_against_a_wall_needs_its_friction(friction, stands):
    """With friction m at floor and wall alike it holds up to tan a = 2 m / (1 - m^2) from the vertical; here a = 0.55:
    m = tan(a / 2) = 0.2822."""
    angle, length, thick = 0.55, 2.0, 0.01
    turn = tipped(angle)
    ladder = box((thick, 0.3, length), (0.0, 0.0, 0.0), turn)
    low = ladder.vertices.min(axis=0)
    high = ladder.vertices.max(axis=0)
    floor = box((9.0, 9.0, 1.0), (0, 0, low[2] - 0.5))
    wall = box((1.0, 9.0, 9.0), (high[0] + 0.5, 0, 0))
    contacts = []
    for ground in (floor, wall):
        points, normals = find_contact_points(ladder, ground, WITHIN_M)
        assert len(points) >= 2
        contacts.append(Contact(0, FIXED, points, normals))
    assert contacts[1].normals == pytest.approx(np.tile([-1.0, 0, 0], (len(contacts[1].points), 1)), abs=1e-9)
    residual = equilibrium_residual([Weight(1.0, np.zeros(3), length)], contacts, friction)[0]
    assert (residual < 1e-9) if stands else (residual > 1e-3)


@pytest.mark.parametrize(("over_m", "stands"), [(0.02, True), (0.049, True), (0.051, False)])
def test_of_a_stack_the_upper_may_not_hang_over_by_half(over_m, stands):
    under, over = box((0.1, 0.1, 0.1), (0, 0, 0.05)), box((0.1, 0.1, 0.1), (over_m, 0, 0.15))
    bodies = [Weight(1.0, np.array([0, 0, 0.05]), 0.17), Weight(1.0, np.array([over_m, 0, 0.15]), 0.17)]
    contacts = [
        Contact(0, FIXED, *find_contact_points(under, GROUND, WITHIN_M)),
        Contact(1, 0, *find_contact_points(over, under, WITHIN_M)),
    ]
    residual = equilibrium_residual(bodies, contacts, 0.5)
    assert (residual.max() < 1e-9) if stands else (residual[1] > 1e-3)


def test_the_lower_of_a_stack_bears_the_upper():
    """A body on the overhanging end of a plate tips it, though the plate alone would stand, and a heavier plate does not."""
    plate, load = box((0.2, 0.1, 0.01), (0.45, 0, 0.005)), box((0.02, 0.02, 0.02), (0.54, 0, 0.02))
    contacts = [
        Contact(0, FIXED, *find_contact_points(plate, GROUND, WITHIN_M)),
        Contact(1, 0, *find_contact_points(load, plate, WITHIN_M)),
    ]
    at = np.array([0.54, 0, 0.02])
    for mass, stands in ((0.7, False), (0.9, True), (500.0, True)):  # 0.05 m in, 0.04 m out: 0.8 kg a kilogram
        bodies = [Weight(mass, np.array([0.45, 0, 0.005]), 0.2), Weight(1.0, at, 0.03)]
        residual = equilibrium_residual(bodies, contacts, 0.5).max()
        assert (residual < 1e-8) if stands else (residual > 1e-3)


def test_two_crossed_bars_touch_where_they_cross():
    bar, other = box((0.3, 0.02, 0.02), (0, 0, 0.03)), box((0.02, 0.3, 0.02), (0, 0, 0.01))
    points, normals = find_contact_points(bar, other, WITHIN_M)
    assert {tuple(p) for p in np.round(points, 9) + 0.0} == {(x, y, 0.02) for x in (-0.01, 0.01) for y in (-0.01, 0.01)}
    assert normals == pytest.approx(np.tile(UP, (len(points), 1)), abs=1e-9)


def test_two_edges_across_one_another_touch_in_one_point():
    """Square bars on their edges, one along x and one along y."""
    along_x = box((0.3, 0.02, 0.02), (0, 0, 0.02 * np.sqrt(0.5)), rotation_about(np.array([1.0, 0, 0]), np.pi / 4))
    along_y = box((0.02, 0.3, 0.02), (0, 0, -0.02 * np.sqrt(0.5)), tipped(np.pi / 4))
    points, normals = find_contact_points(along_x, along_y, WITHIN_M)
    assert points == pytest.approx(np.zeros((1, 3)), abs=1e-9)
    assert normals == pytest.approx(UP[None, :], abs=1e-9)


def test_a_ring_hangs_on_a_peg():
    """A square ring over a square bar: forces from its concave side bear it from above its centre of mass."""
    ring = trimesh.boolean.difference([trimesh.creation.box((0.1, 0.02, 0.1)), trimesh.creation.box((0.08, 0.1, 0.08))])
    peg = box((0.01, 0.2, 0.01), (0.0, 0.0, 0.035))
    points, normals = find_contact_points(mesh_of(ring), peg, WITHIN_M)
    assert points[:, 2] == pytest.approx(0.04, abs=1e-9)
    assert normals == pytest.approx(np.tile(UP, (len(points), 1)), abs=1e-9)
    assert rest(mesh_of(ring), peg, (0, 0, 0), 0.14) < 1e-9


def test_a_ball_and_a_coin_on_its_edge_are_in_equilibrium_on_one_point():
    ball = trimesh.creation.uv_sphere(0.05, count=[32, 32])
    assert rest(mesh_of(ball, pose(np.eye(3), np.array([0, 0, 0.05]))), GROUND, (0, 0, 0.05), 0.1) < 1e-9
    coin = trimesh.creation.cylinder(0.01, 0.002, sections=64)
    turned = pose(rotation_about(np.array([1.0, 0, 0]), np.pi / 2), np.zeros(3))
    lying = mesh_of(coin, turned)
    lifted = Mesh(lying.vertices - [0, 0, lying.vertices[:, 2].min()], lying.faces)
    assert rest(lifted, GROUND, lifted.vertices.mean(axis=0), 0.02) < 1e-9


def test_what_is_frozen_on_one_corner_is_not_in_equilibrium():
    turn = tipped(0.3) @ rotation_about(np.array([1.0, 0, 0]), 0.2)
    cube = box((0.1, 0.1, 0.1), (0, 0, 0), turn)
    cube = Mesh(cube.vertices - cube.vertices[np.argmin(cube.vertices[:, 2])], cube.faces)
    com = cube.vertices.mean(axis=0)
    lever = np.hypot(*com[:2]) / 0.17
    assert rest(cube, GROUND, com, 0.17, friction=0.0) == pytest.approx(lever / (1 + lever**2), rel=1e-6)


def test_forces_are_shared_between_a_thousandfold_of_masses():
    bodies = [Weight(1.0, np.array([0, 0, 0.05]), 0.17), Weight(1000.0, np.array([0, 0, 0.15]), 0.17)]
    under, over = box((0.1, 0.1, 0.1), (0, 0, 0.05)), box((0.1, 0.1, 0.1), (0.01, 0, 0.15))
    contacts = [
        Contact(0, FIXED, *find_contact_points(under, GROUND, WITHIN_M)),
        Contact(1, 0, *find_contact_points(over, under, WITHIN_M)),
    ]
    assert equilibrium_residual(bodies, contacts, 0.5).max() < 1e-7
    assert equilibrium_residual(bodies[::-1], contacts, 0.5).max() < 1e-7


def test_the_margin_is_the_distance_to_the_outline():
    square = np.array([(x, y, 0.1 * x) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    assert support_margin_m(square, np.array([0.7, 0.0, 5.0])) == pytest.approx(0.3)
    assert support_margin_m(square, np.array([1.3, 1.4, 5.0])) == pytest.approx(-0.5)
    assert support_margin_m(square[:2], np.array([-1.2, 0.3, 0.0])) == pytest.approx(-0.2)
    assert support_margin_m(square[:1], np.array([-1.0, -1.5, 0.0])) == pytest.approx(-0.5)
    assert support_margin_m(np.empty((0, 3)), np.zeros(3)) == -np.inf


def test_a_ball_on_the_deepest_face_of_a_hollow_is_held_by_it():
    """All faces about the deepest one rise, as they do about the underside of a body; yet the ball is above."""
    dish = trimesh.creation.box((0.2, 0.2, 0.1)).difference(
        trimesh.creation.icosphere(3, 0.09).apply_translation([0, 0, 0.07])
    )
    vertices = np.asarray(dish.vertices)
    over = dish.triangles_center
    middle = (np.abs(over[:, :2]).max(axis=1) < 0.02) & (over[:, 2] > -0.04)
    deepest = int(np.flatnonzero(middle)[np.argmin(over[middle, 2])])
    point, normal = dish.triangles_center[deepest], dish.face_normals[deepest]
    ball = trimesh.creation.icosphere(3, 0.03)
    ball.apply_translation(point - ball.vertices[np.argmin(ball.vertices @ normal)])
    points, normals = find_contact_points(
        mesh_of(ball), Mesh(vertices, np.asarray(dish.faces, dtype=np.int32)), WITHIN_M / 10
    )
    assert len(points) >= 1
    assert normals[np.argmin(np.linalg.norm(points - point, axis=1))] == pytest.approx(normal, abs=1e-6)
