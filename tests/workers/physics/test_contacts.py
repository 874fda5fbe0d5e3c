"""Compiled loops over features: boxes near boxes, a corner over a face, and an edge across another.

Features of meshes whose corners, edges and sides are known; what is near, against FCL; and pieces, by what is inside.
Signed contacts of bodies whose places and normals are known; the compiled loops are tested with them.
"""

import fcl
import manifold3d
import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.kit.contacts import UP as UPWARDS
from tests.kit.contacts import box, contacts_between, mesh_of, tipped
from workers.geometry.frames import pose, rotation_about, uniform_rotation
from workers.physics.contact_surface import (
    Surface,
    crop,
    faces_within,
    find_near,
    skin_of,
    surface_of,
)

UP, DOWN, NEITHER = np.array([1]), np.array([-1]), np.array([0])


def test_the_pairs_that_are_near_are_those_of_every_box_with_every_other():
    rng = np.random.default_rng(0)
    low, others = rng.uniform(0, 1, (80, 3)), rng.uniform(0, 1, (300, 3))
    high, others_high = low + rng.uniform(0, 0.1, (80, 3)), others + rng.uniform(0, 0.2, (300, 3))
    found = find_near(low, high, others, others_high, 0.03)
    near = ((low[:, None] - 0.03 <= others_high) & (others - 0.03 <= high[:, None])).all(axis=2)
    assert 64 < near.sum() < 5000
    assert {tuple(pair) for pair in found.tolist()} == {tuple(pair) for pair in np.argwhere(near).tolist()}
    assert (np.diff(found[:, 0]) >= 0).all()
    assert len(find_near(low, high, others[:0], others[:0], 0.03)) == 0


DEEP_M = 1e-3


def test_a_box_has_eight_corners_twelve_edges_and_its_body_below_every_face():
    surface = surface_of(box((0.1, 0.2, 0.3)), True)
    assert (len(surface.corners), len(surface.edges), len(surface.faces)) == (8, 12, 12)
    assert (surface.side == 1).all()


def test_a_part_has_all_that_shares_a_corner_with_what_overlaps_the_box():
    ball = mesh_of(trimesh.creation.icosphere(3, 0.05))
    low, high = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, -0.045])
    part = crop(ball, low, high)
    assert 0 < len(part.faces) < len(ball.faces) / 2
    touched = np.unique(ball.faces[(ball.vertices[ball.faces][:, :, 2].min(axis=1) <= -0.045)])
    sharing = np.isin(ball.faces, touched).any(axis=1)
    assert {tuple(face) for face in ball.faces[sharing].tolist()} <= {tuple(face) for face in part.faces.tolist()}


def surface(mesh: trimesh.Trimesh, closed: bool = True) -> Surface:
    return surface_of(Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)), closed)


def distance_m(one: np.ndarray, other: np.ndarray) -> float:
    bodies = []
    for triangle in (one, other):
        model = fcl.BVHModel()
        model.beginModel(3, 1)
        model.addSubModel(triangle, np.array([[0, 1, 2]]))
        model.endModel()
        bodies.append(fcl.CollisionObject(model))
    return fcl.distance(*bodies)


@pytest.mark.parametrize("within_m", [0.1, 0.15, 0.3])
def test_faces_are_near_where_fcl_finds_their_triangles_within_the_distance(within_m):
    """Triangles with two corners at one place are left to nobody: surfaces have none."""
    chance = np.random.default_rng(7)
    here, there = (chance.uniform(0.0, 1.0, (60, 3, 3)) * [1, 1, 0.5] + [0, 0, z] for z in (0.0, 0.4))
    here, there = (middles(each) for each in (here, there))
    numbers = np.arange(180).reshape(60, 3)
    near = faces_within((here.reshape(-1, 3), numbers), (there.reshape(-1, 3), numbers), within_m)
    true = np.array([[distance_m(a, b) for b in there] for a in here])
    assert np.abs(true - within_m).min() > 1e-6
    assert near[0].tolist() == np.flatnonzero((true <= within_m).any(axis=1)).tolist()
    assert near[1].tolist() == np.flatnonzero((true <= within_m).any(axis=0)).tolist()
    assert 0 < len(near[0]) < 60


def middles(triangles: np.ndarray) -> np.ndarray:
    """The triangles at a third of their size, about their middles."""
    middle = triangles.mean(axis=1, keepdims=True)
    return np.ascontiguousarray(middle + (triangles - middle) / 3.0)


def wedge(angle_deg: float) -> trimesh.Trimesh:
    """A prism of 100 mm with an edge of this angle along y."""
    rise = 0.05 * np.tan(np.radians(angle_deg) / 2.0)
    points = [[x, y, z] for y in (0.0, 0.1) for x, z in ((0.0, 0.0), (0.05, rise), (0.05, -rise))]
    return trimesh.convex.convex_hull(np.array(points))


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.annulus(0.03, 0.05, 0.1, sections=24),
        wedge(60.0),
        wedge(10.0),
        wedge(1.0),
        trimesh.creation.icosphere(2, 0.05),
    ],
    ids=["tube", "wedge of 60 degrees", "wedge of 10 degrees", "wedge of 1 degree", "ball"],
)
def test_no_piece_reaches_out_of_the_mesh(mesh):
    whole = manifold3d.Manifold(manifold3d.Mesh64(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.uint64)))
    assert whole.volume() > 0.0
    for piece in skin_of(surface(mesh), np.arange(len(mesh.faces)), DEEP_M):
        assert (manifold3d.Manifold.hull_points(np.ascontiguousarray(piece)) - whole).volume() < 1e-15


WITHIN_M = 5e-5
GROUND = box((1.0, 1.0, 0.1), (0, 0, -0.05))


def rows(points) -> set[tuple[float, ...]]:
    return {tuple(row) for row in np.round(points, 6) + 0.0}


def touching(upper: Mesh, lower: Mesh, within_m: float = WITHIN_M):
    return contacts_between([upper, lower], within_m)


@pytest.mark.parametrize("gap_m", [0.0, 4e-5, -4e-5])
def test_a_box_on_a_level_touches_it_with_four_corners_as_far_off_as_it_is(gap_m):
    found = touching(box((0.1, 0.2, 0.3), (0, 0, 0.15 + gap_m)), GROUND)
    assert rows(found.points[:, :2]) == {(x, y) for x in (-0.05, 0.05) for y in (-0.1, 0.1)}
    assert found.normals == pytest.approx(np.tile(UPWARDS, (len(found.gaps), 1)), abs=1e-12)
    assert found.gaps == pytest.approx(gap_m, abs=1e-12)
    assert (found.upper == 0).all() and (found.lower == 1).all()


@pytest.mark.parametrize("gap_m", [2e-5, -2e-5])
def test_two_edges_across_one_another_touch_in_one_point(gap_m):
    """Square bars on their edges, one along x and one along y."""
    along_x = box(
        (0.3, 0.02, 0.02), (0, 0, 0.02 * np.sqrt(0.5) + gap_m), rotation_about(np.array([1.0, 0, 0]), np.pi / 4)
    )
    along_y = box((0.02, 0.3, 0.02), (0, 0, -0.02 * np.sqrt(0.5)), tipped(np.pi / 4))
    found = touching(along_x, along_y)
    assert found.points == pytest.approx(np.array([[0, 0, gap_m / 2]]), abs=1e-9)
    assert found.normals == pytest.approx(UPWARDS[None, :], abs=1e-9)
    assert found.gaps == pytest.approx(gap_m, abs=1e-9)


def test_many_contacts_are_all_found():
    """More than the sixty-four that the loops begin with."""
    feet = [box((0.01, 0.01, 0.02), (x, y, 0.01)) for x in np.arange(-5, 5) * 0.09 for y in np.arange(-5, 5) * 0.09]
    starts = np.arange(len(feet)) * len(feet[0].vertices)
    faces = np.concatenate([foot.faces + start for foot, start in zip(feet, starts, strict=True)])
    comb = Mesh(np.concatenate([foot.vertices for foot in feet]), faces.astype(np.int32))
    assert len(rows(touching(comb, GROUND).points)) == 400


def test_the_way_faces_are_wound_does_not_turn_normals():
    upper = box((0.1, 0.1, 0.1), (0.47, 0, 0.05))
    inside_out = Mesh(GROUND.vertices, np.ascontiguousarray(GROUND.faces[:, ::-1]))
    for lower in (GROUND, inside_out):
        for top in (upper, Mesh(upper.vertices, np.ascontiguousarray(upper.faces[:, ::-1]))):
            found = touching(top, lower)
            assert len(found.gaps) >= 4
            assert found.normals == pytest.approx(np.tile(UPWARDS, (len(found.gaps), 1)), abs=1e-9)


def test_a_corner_leaves_a_body_the_shorter_way():
    """A tip 0.02 mm below the top and 0.04 mm inside the side: 0.02 mm up is the way out."""
    turn = tipped(0.5) @ rotation_about(np.array([1.0, 0, 0]), 0.5)
    tip = box((0.1, 0.1, 0.1), (0, 0, 0), turn)
    low = tip.vertices[np.argmin(tip.vertices[:, 2])]
    tip = Mesh(tip.vertices - low + [0.5 - 4e-5, 0, -2e-5], tip.faces)
    found = touching(tip, GROUND)
    assert found.gaps.min() == pytest.approx(-2e-5, abs=1e-12)
    assert found.normals[np.argmin(found.gaps)] == pytest.approx(UPWARDS)


def test_a_ball_on_the_deepest_face_of_a_hollow_is_held_by_it():
    """All faces about the deepest one rise, as they do about the underside of a body; yet the ball is above."""
    dish = trimesh.creation.box((0.2, 0.2, 0.1)).difference(
        trimesh.creation.icosphere(3, 0.09).apply_translation([0, 0, 0.07])
    )
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


def test_a_body_of_a_thousand_facets_in_any_pose_has_its_lowest_corner_as_its_gap():
    rng = np.random.default_rng(5)
    ball = trimesh.creation.icosphere(3, 0.05)
    for _ in range(10):
        at = mesh_of(ball, pose(uniform_rotation(rng), np.zeros(3)))
        lowest = at.vertices[:, 2].min()
        found = touching(Mesh(at.vertices + np.array([0, 0, 1e-5 - lowest]), at.faces), GROUND)
        assert found.gaps.min() == pytest.approx(1e-5, abs=1e-12)
