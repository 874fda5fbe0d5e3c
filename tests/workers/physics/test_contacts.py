"""The contacts of true meshes, how bodies come to rest, and how objects lie, against what can be worked out by hand.

What is near is held against FCL, pieces against manifold3d.
"""

import itertools
import math

import fcl
import manifold3d
import numpy as np
import pytest
import trimesh

from schemas.job.physics import Physics
from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import REGION_TABLE, Mesh
from tests.hard_cases.bodies import cube
from tests.hard_cases.drops import level
from tests.kit.contacts import UP, box, contacts_between, mesh_of, thing_of, tipped
from tests.physics.settling import start_at
from workers.geometry.frames import pose, rotation_about, transform, translation, uniform_rotation
from workers.physics import exact_rest
from workers.physics.contact_surface import crop, faces_within, find_near, skin_of, surface_of
from workers.physics.contacts import Contacts, contacts_within
from workers.physics.exact_rest import Rested, rest
from workers.physics.placement import FARTHEST_M, Form, Support, find_gaps_m, find_overlaps_m, measure_supports, place
from workers.physics.placement import forms_of as forms

X = np.array([1.0, 0.0, 0.0])
EYE = np.eye(4)
GROUND = box((1.0, 1.0, 0.1), (0, 0, -0.05))

# ---------------------------------------------------------------------------------------------- features


def test_the_pairs_that_are_near_are_those_of_every_box_with_every_other():
    rng = np.random.default_rng(0)
    low, others = rng.uniform(0, 1, (80, 3)), rng.uniform(0, 1, (300, 3))
    high, others_high = low + rng.uniform(0, 0.1, (80, 3)), others + rng.uniform(0, 0.2, (300, 3))
    others[7], others_high[7] = [-9.0, -9.0, 0.4], [9.0, 9.0, 0.5]  # as wide as a floor
    found = find_near(low, high, others, others_high, 0.03)
    near = ((low[:, None] - 0.03 <= others_high) & (others - 0.03 <= high[:, None])).all(axis=2)
    assert 64 < near.sum() < 5000
    assert {tuple(pair) for pair in found.tolist()} == {tuple(pair) for pair in np.argwhere(near).tolist()}
    assert (np.diff(found[:, 0]) >= 0).all()
    assert len(find_near(low, high, others[:0], others[:0], 0.03)) == 0


def test_a_part_has_all_that_shares_a_corner_with_what_overlaps_the_box():
    ball = mesh_of(trimesh.creation.icosphere(3, 0.05))
    part = crop(ball, np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, -0.045]))
    assert 0 < len(part.faces) < len(ball.faces) / 2
    touched = np.unique(ball.faces[(ball.vertices[ball.faces][:, :, 2].min(axis=1) <= -0.045)])
    sharing = np.isin(ball.faces, touched).any(axis=1)
    assert {tuple(face) for face in ball.faces[sharing].tolist()} <= {tuple(face) for face in part.faces.tolist()}


def distance_m(*triangles: np.ndarray) -> float:
    bodies = []
    for triangle in triangles:
        model = fcl.BVHModel()
        model.beginModel(3, 1)
        model.addSubModel(triangle, np.array([[0, 1, 2]]))
        model.endModel()
        bodies.append(fcl.CollisionObject(model))
    return fcl.distance(*bodies)


def test_faces_are_near_where_fcl_finds_their_triangles_within_the_distance():
    """Small triangles that do not pierce one another: of 60 with 60 others below them."""
    chance, numbers = np.random.default_rng(7), np.arange(180).reshape(60, 3)
    here, there = (chance.uniform(0.0, 1.0, (60, 3, 3)) * [1, 1, 0.5] + [0, 0, z] for z in (0.0, 0.4))
    here, there = (each.mean(axis=1, keepdims=True) * 2 / 3 + each / 3 for each in (here, there))
    true = np.array([[distance_m(a, b) for b in there] for a in here])
    for within_m in (0.1, 0.15, 0.3):
        near = faces_within((here.reshape(-1, 3), numbers), (there.reshape(-1, 3), numbers), within_m)
        assert np.abs(true - within_m).min() > 1e-6
        assert near[0].tolist() == np.flatnonzero((true <= within_m).any(axis=1)).tolist()
        assert near[1].tolist() == np.flatnonzero((true <= within_m).any(axis=0)).tolist()
        assert 0 < len(near[0]) < 60


def wedge(angle_deg: float) -> trimesh.Trimesh:
    """A prism of 100 mm with an edge of this angle along y."""
    rise = 0.05 * np.tan(np.radians(angle_deg) / 2.0)
    points = [[x, y, z] for y in (0.0, 0.1) for x, z in ((0.0, 0.0), (0.05, rise), (0.05, -rise))]
    return trimesh.convex.convex_hull(np.array(points))


def test_no_piece_of_a_skin_reaches_out_of_the_mesh():
    tube, ball = trimesh.creation.annulus(0.03, 0.05, 0.1, sections=24), trimesh.creation.icosphere(2, 0.05)
    for mesh in (tube, ball, wedge(60.0), wedge(10.0), wedge(1.0)):
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        whole = manifold3d.Manifold(manifold3d.Mesh64(vertices, faces.astype(np.uint64)))
        assert whole.volume() > 0.0
        for piece in skin_of(surface_of(Mesh(vertices, faces), True), np.arange(len(faces)), 1e-3, 0.0):
            assert (manifold3d.Manifold.hull_points(np.ascontiguousarray(piece)) - whole).volume() < 1e-15


# ---------------------------------------------------------------------------------------------- contacts

WITHIN_M = 5e-5


def rows(points) -> set[tuple[float, ...]]:
    return {tuple(row) for row in np.round(points, 6) + 0.0}


def touching(upper: Mesh, lower: Mesh = GROUND, within_m: float = WITHIN_M):
    return contacts_between([upper, lower], within_m)


def test_a_box_on_a_level_touches_it_with_four_corners_as_far_off_as_it_is():
    for gap_m in (0.0, 4e-5, -4e-5):
        found = touching(box((0.1, 0.2, 0.3), (0, 0, 0.15 + gap_m)))
        assert rows(found.points[:, :2]) == {(x, y) for x in (-0.05, 0.05) for y in (-0.1, 0.1)}
        assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)), abs=1e-12)
        assert found.gaps == pytest.approx(gap_m, abs=1e-12)
        assert (found.upper == 0).all() and (found.lower == 1).all()


def test_two_edges_across_one_another_touch_in_one_point():
    """Square bars on their edges, one along x and one along y."""
    for gap_m in (2e-5, -2e-5):
        high = 0.02 * np.sqrt(0.5)
        along_x = box((0.3, 0.02, 0.02), (0, 0, high + gap_m), rotation_about(X, np.pi / 4))
        found = touching(along_x, box((0.02, 0.3, 0.02), (0, 0, -high), tipped(np.pi / 4)))
        assert found.points == pytest.approx(np.array([[0, 0, gap_m / 2]]), abs=1e-9)
        assert found.normals == pytest.approx(UP[None, :], abs=1e-9)
        assert found.gaps == pytest.approx(gap_m, abs=1e-9)


@pytest.mark.parametrize("gap_m", [1e-6, 0.0, -1e-6])
def test_two_rings_that_pull_on_one_another_in_inner_corners_of_their_holes_touch_there(gap_m):
    """Rings of eight sides, 25 mm to the inner corners, one across the other: all nearest points are at the ends of edges."""
    ring = trimesh.creation.torus(0.03, 0.005, major_sections=8, minor_sections=4)
    other = ring.copy().apply_transform(pose(rotation_about(X, np.pi / 2), np.array([0.05 - gap_m, 0.0, 0.0])))
    found = touching(mesh_of(ring), mesh_of(other))
    assert len(found.gaps) >= 2 and np.abs(found.gaps).max() <= 1e-6
    assert (np.abs(found.normals[:, 0]) > 0.7).all()


def test_many_contacts_are_all_found():
    """More than the sixty-four that the loops begin with."""
    feet = [box((0.01, 0.01, 0.02), (x, y, 0.01)) for x in np.arange(-5, 5) * 0.09 for y in np.arange(-5, 5) * 0.09]
    faces = np.concatenate([foot.faces + 8 * number for number, foot in enumerate(feet)])
    comb = Mesh(np.concatenate([foot.vertices for foot in feet]), faces.astype(np.int32))
    assert len(rows(touching(comb).points)) == 400


def test_the_way_faces_are_wound_does_not_turn_normals():
    upper = box((0.1, 0.1, 0.1), (0.47, 0, 0.05))
    for ways in itertools.product((1, -1), repeat=2):
        wound = zip((upper, GROUND), ways, strict=True)
        found = touching(*(Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::way])) for mesh, way in wound))
        assert len(found.gaps) >= 4
        assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)), abs=1e-9)


def test_a_corner_leaves_a_body_the_shorter_way():
    """A tip 0.02 mm below the top and 0.04 mm inside the side: 0.02 mm up is the way out."""
    tip = box((0.1, 0.1, 0.1), (0, 0, 0), tipped(0.5) @ rotation_about(X, 0.5))
    low = tip.vertices[np.argmin(tip.vertices[:, 2])]
    found = touching(Mesh(tip.vertices - low + [0.5 - 4e-5, 0, -2e-5], tip.faces))
    assert found.gaps.min() == pytest.approx(-2e-5, abs=1e-12)
    assert found.normals[np.argmin(found.gaps)] == pytest.approx(UP)


def test_a_ball_on_the_deepest_face_of_a_hollow_is_held_by_it():
    """All faces about the deepest one rise, as they do about the underside of a body; yet the ball is above."""
    hollow = trimesh.creation.icosphere(3, 0.09).apply_translation([0, 0, 0.07])
    dish = trimesh.creation.box((0.2, 0.2, 0.1)).difference(hollow)
    over = dish.triangles_center
    middle = (np.abs(over[:, :2]).max(axis=1) < 0.02) & (over[:, 2] > -0.04)
    deepest = int(np.flatnonzero(middle)[np.argmin(over[middle, 2])])
    point, normal = dish.triangles_center[deepest], dish.face_normals[deepest]
    ball = trimesh.creation.icosphere(3, 0.03)
    ball.apply_translation(point - ball.vertices[np.argmin(ball.vertices @ normal)])
    found = touching(mesh_of(ball), mesh_of(dish), WITHIN_M / 10)
    nearest = np.argmin(np.linalg.norm(found.points - point, axis=1))
    assert found.normals[nearest] == pytest.approx(normal, abs=1e-6)
    assert found.gaps[nearest] == pytest.approx(0.0, abs=1e-9)


def _grooved() -> trimesh.Trimesh:
    grooves = [trimesh.creation.box((0.2, 0.004, 0.0006)).apply_translation((0, y, 0.02)) for y in (-0.01, 0.0, 0.012)]
    return trimesh.creation.box((0.07, 0.05, 0.04)).difference(trimesh.boolean.union(grooves))


def _tray() -> trimesh.Trimesh:
    hollow = trimesh.creation.box((0.117, 0.097, 0.03)).apply_translation((0, 0, 0.001))
    return trimesh.creation.box((0.12, 0.1, 0.03)).difference(hollow)


@pytest.mark.parametrize(
    ("upper", "lower", "T", "turns"),
    [
        pytest.param(
            _grooved(), _grooved(), pose(rotation_about(X, math.pi), np.array([0, 0, 0.0401])), (1.5, 1.6), id="grooves"
        ),
        pytest.param(
            trimesh.creation.box((0.00175, 0.06, 0.05)),
            _tray(),
            translation(0.0575, 0, 0.018),
            (-2e-3, 2e-3),
            id="back of a plate",
        ),
    ],
)
def test_bodies_that_are_apart_have_no_contact_that_overlaps(upper, lower, T, turns):
    rng, surfaces = np.random.default_rng(7), [surface_of(mesh_of(each), True, True) for each in (upper, lower)]
    for _ in range(10):
        turned = T @ pose(rotation_about(UP, rng.uniform(*turns)), np.zeros(3))
        found = contacts_within(surfaces, [turned, EYE], 0.003)
        assert trimesh.boolean.intersection([upper.copy().apply_transform(turned), lower]).is_empty
        assert len(found.gaps) and found.gaps.min() > -1e-6


# ---------------------------------------------------------------------------------------------- one step from rest

G = 9.81


# ---------------------------------------------------------------------------------------------- until nothing moves

CUBE = box((0.1, 0.1, 0.1))


def settle(meshes: list[Mesh], poses, ground: Mesh = GROUND, masses=None) -> Rested:
    masses = masses or [1.0] * len(meshes)
    things = [thing_of(mesh, mass) for mesh, mass in zip(meshes, masses, strict=True)]
    return rest(things, poses, surface_of(ground, True), np.full(len(things) + 1, 0.7))


def on_ground(mesh: Mesh, R, up_m: float = 0.0):
    """The pose with this turn and the lowest vertex so high."""
    return pose(R, np.array([0.0, 0.0, up_m - (mesh.vertices @ R.T)[:, 2].min()]))


def test_what_rests_is_left_to_the_bit_and_the_same_bodies_come_to_the_same_bits():
    T = translation(0.0, 0.0, 0.05)
    found = settle([CUBE], [T])
    assert found.steps == 0 and found.poses[0].tobytes() == T.tobytes()
    at = [pose(uniform_rotation(np.random.default_rng(1)), np.array([0.0, 0.0, 0.09])), translation(0.3, 0.0, 0.0503)]
    one, other = (settle([CUBE] * 2, at) for _ in range(2))
    assert [T.tobytes() for T in one.poses] == [T.tobytes() for T in other.poses]
    assert one.steps == other.steps


@pytest.mark.parametrize("guess", ["the answer", "none", "of other contacts"])
def test_a_step_from_likely_forces_is_optimal_whatever_they_are(guess):
    """The conditions of Karush, Kuhn and Tucker for the least motion of 24 variables that keeps 50 contacts of 16 edges."""
    chance, shape = np.random.default_rng(3), (50, 16)
    normals = np.repeat(chance.normal(size=(50, 24)), 16, axis=0)
    matrix = normals + 0.3 * chance.normal(size=(800, 24))
    least = matrix @ chance.normal(size=24) - np.repeat(chance.exponential(0.5, 50), 16)
    x, multipliers = exact_rest._least_distance(matrix, least)
    rolled = {"the answer": multipliers, "none": 0.0 * multipliers, "of other contacts": np.roll(multipliers, 160)}
    x, multipliers = exact_rest._least_distance(matrix, least, rolled[guess].reshape(shape))
    assert np.linalg.norm(x) > 0.1 and (multipliers <= 1e-9).all()
    assert x == pytest.approx(-matrix.T @ multipliers, abs=1e-8)
    assert (matrix @ x >= least - 1e-8).all()
    assert np.abs(multipliers * (matrix @ x - least)).max() < 1e-8


def test_what_is_balanced_on_an_edge_is_not_at_rest():
    """A prism exactly on a ridge: in balance, and gone at a breath."""
    prism = mesh_of(trimesh.creation.cylinder(0.05, 0.2, sections=32))
    found = settle([prism], [on_ground(prism, rotation_about(X, math.pi / 2))])
    assert found.still
    assert found.poses[0][2, 3] == pytest.approx(0.05 * math.cos(math.pi / 32), abs=1e-8)


# ---------------------------------------------------------------------------------------------- gaps

CUBE_FORM, GROUND_FORM = Form(CUBE), Form(box((2.0, 2.0, 0.1), (0, 0, -0.05)))


@pytest.mark.parametrize(
    ("deep_m", "calls", "still"), [(9.5e-4, 3, True), (9.5e-4, 10**6, False), (5e-5, 10**6, False)]
)
def test_what_passes_a_deep_crossing_that_nothing_can_undo_comes_to_rest_behind_it_and_never_in_it(
    deep_m, calls, still, monkeypatch
):
    """A box on the ground with a contact that would push it further down, for so many calls, as edges of a wall make it."""
    true, count = exact_rest.find_contacts, itertools.count()

    def with_crossing(*arguments):
        found = true(*arguments)
        if next(count) >= calls:
            return found
        rows = zip(
            (found.upper, found.lower, found.points, found.normals, found.gaps),
            (0, 1, UP * 0, -UP, -deep_m),
            strict=True,
        )
        return Contacts(*(np.concatenate([all_of, np.array([one], all_of.dtype)]) for all_of, one in rows))

    monkeypatch.setattr(exact_rest, "find_contacts", with_crossing)
    rested = settle([CUBE], [translation(0.0, 0.0, 0.0505)])
    assert rested.still == still
    assert rested.poses[0][2, 3] == pytest.approx(0.05, abs=1e-8)


def gap(one: Form, T_one, other: Form, T_other) -> float:
    """Of two, who are told the same."""
    a, b = find_gaps_m([one, other], [T_one, T_other])
    assert a == b
    return a


def test_two_boxes_are_as_near_or_as_deep_as_they_were_put():
    for axis, gap_m in itertools.product(np.eye(3), (1e-5, 0.003, 0.0099, -1e-5, -0.002, -0.03)):
        found = gap(CUBE_FORM, EYE, CUBE_FORM, translation(*(axis * (0.1 + gap_m))))
        assert found == pytest.approx(gap_m, abs=1e-9)


def test_no_two_tilted_boxes_are_apart_where_no_axis_separates_them_nor_the_other_way_round():
    """Two convex bodies are apart if and only if one of their normals, or of their edges' products, separates them."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        turns = [uniform_rotation(rng) for _ in range(2)]
        poses = [pose(turns[0], np.zeros(3)), pose(turns[1], rng.uniform(-0.1, 0.1, 3))]
        a, b = (transform(T, CUBE.vertices) for T in poses)
        axes = [*turns[0].T, *turns[1].T, *(np.cross(u, v) for u, v in itertools.product(turns[0].T, turns[1].T))]
        apart = max(
            max(float((b @ n).min() - (a @ n).max()), float((a @ n).min() - (b @ n).max()))
            for n in (axis / np.linalg.norm(axis) for axis in axes)
        )
        found = gap(CUBE_FORM, poses[0], CUBE_FORM, poses[1])
        if apart > 0.0:
            assert found >= min(apart, FARTHEST_M) - 1e-9  # no less than along any axis
        else:
            assert -0.1 <= found < 0.0


def test_an_overlap_is_the_depth_and_nothing_where_two_bodies_only_touch_or_are_apart():
    for way, expected in {0.098: 0.002, 0.1: 0.0, 0.11: 0.0, 3.0: 0.0}.items():
        depths = [depth for _, _, depth in find_overlaps_m([CUBE_FORM] * 2, [EYE, translation(0, way, 0)])]
        assert max(depths, default=0.0) == pytest.approx(expected, abs=1e-9), way


# ---------------------------------------------------------------------------------------------- supports

TABLE = level()
TOP = TABLE.top.height_m
STARTED = start_at(cube())


def held(start: ObjectStart, T: np.ndarray, on: Table = TABLE) -> Support:
    return measure_supports(place([start], [T], forms([start]), on, Physics()), [T])[0]


def test_a_box_on_a_level_is_held_by_corners_of_its_face_with_a_margin_of_half_its_side():
    support = held(STARTED, translation(0.1, 0.0, TOP + 0.05))
    assert (support.margin_m, support.gap_m) == (pytest.approx(0.05, abs=1e-9), pytest.approx(0.0, abs=1e-9))
    assert support.unbalanced < 1e-9
    weight = [0, 0, STARTED.asset.mass.mass_kg * G]
    assert sum(contact.force for contact in support.forces) == pytest.approx(weight, abs=1e-9)
    for contact in support.forces:
        assert contact.with_region == REGION_TABLE
        assert np.abs(contact.point - [0.1, 0.0, TOP]) == pytest.approx([0.05, 0.05, 0.0], abs=1e-9)
        assert contact.normal == pytest.approx([0, 0, 1])


def test_what_encloses_no_body_counts_as_its_hull_where_overlaps_are_sought():
    open_cube = Form(Mesh(CUBE.vertices, CUBE.faces[2:]))
    ((_, _, depth_m),) = find_overlaps_m([open_cube, CUBE_FORM], [EYE, translation(0, 0.098, 0)])
    assert depth_m == pytest.approx(0.002, abs=1e-9)


def test_a_dimple_above_the_floor_of_a_tray_is_not_taken_for_what_lies_below_it():
    """All about its corner lies lower, as about one that met the floor from below; 2 mm up, it touches nothing."""
    cube = trimesh.creation.box((0.04, 0.04, 0.04))
    under = np.flatnonzero((cube.vertices[cube.faces][..., 2] < 0.0).all(axis=1))
    rim = np.flatnonzero(cube.vertices[:, 2] < 0.0)
    order = rim[np.argsort(np.arctan2(cube.vertices[rim, 1], cube.vertices[rim, 0]))]
    apex = len(cube.vertices)
    fan = [(order[(k + 1) % 4], order[k], apex) for k in range(4)]
    faces = np.concatenate([np.delete(cube.faces, under, axis=0), fan])
    dimpled = trimesh.Trimesh(np.concatenate([cube.vertices, [(0.0, 0.0, -0.018)]]), faces, process=False)
    assert dimpled.is_watertight and dimpled.volume > 0.0
    hollow = trimesh.boolean.difference(
        [
            trimesh.creation.box((0.2, 0.2, 0.06)),
            trimesh.creation.box((0.18, 0.18, 0.06)).apply_translation((0, 0, 0.01)),
        ]
    )
    above = np.eye(4)
    above[2, 3] = hollow.vertices[:, 2].min() + 0.01 + 0.02 + 1e-4
    for outward, fewest in ((True, 0.0), (False, -0.003)):
        surfaces = [surface_of(mesh_of(each), True, outward) for each in (dimpled, hollow)]
        gaps = contacts_within(surfaces, [above, np.eye(4)], 0.003).gaps
        assert len(gaps) and bool(gaps.min() >= 0.0) is outward and gaps.min() >= fewest


@pytest.mark.parametrize("radius_m", [0.03, 0.06])
@pytest.mark.parametrize("lean_deg", [0.3, 5.0])
def test_what_hangs_ends_its_swing_below_what_it_hangs_on(radius_m, lean_deg):
    """A ring on the two edges of a bar. Its length is far below the free fall of the longest step, 400 mm."""
    upright = pose(rotation_about(np.array([0.0, 1.0, 0.0]), math.pi / 2), np.zeros(3))
    ring = mesh_of(trimesh.creation.torus(radius_m, 0.1 * radius_m, 48, 24), upright)
    bar = box((10 * radius_m, 0.2 * radius_m, 0.1 * radius_m))
    found = settle([ring], [pose(tipped(math.radians(lean_deg)), np.array([0.0, 0.0, -0.838 * radius_m]))], bar)
    assert found.still
    assert abs(found.poses[0][0, 2]) < 1e-5  # turned by so many radians about the bar's short side
