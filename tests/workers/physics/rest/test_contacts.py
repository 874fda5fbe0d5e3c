"""Signed contacts of bodies whose places and normals are known; the compiled loops are tested with them."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.kit.contacts import UP, box, contacts_between, mesh_of, tipped
from workers.geometry.frames import pose, rotation_about, uniform_rotation
from workers.physics.contact_surface import surface_of
from workers.physics.contacts import DEEPEST_M, contacts_within

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
    assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)), abs=1e-12)
    assert found.gaps == pytest.approx(gap_m, abs=1e-12)
    assert (found.upper == 0).all() and (found.lower == 1).all()


def test_contacts_are_those_of_surfaces_at_their_poses():
    cube = surface_of(box((0.1, 0.1, 0.1)), closed=True)
    at = pose(rotation_about(UP, np.pi / 2), np.array([0.2, 0.0, 0.05 + 3e-5]))
    found = contacts_within([cube, surface_of(GROUND, closed=True)], [at, np.eye(4)], WITHIN_M)
    assert rows(found.points[:, :2]) == {(x, y) for x in (0.15, 0.25) for y in (-0.05, 0.05)}
    assert found.gaps == pytest.approx(3e-5, abs=1e-12)


@pytest.mark.parametrize("gap_m", [6e-5, -6e-5, 0.01])
def test_nothing_touches_beyond_the_distance(gap_m):
    assert len(touching(box((0.1, 0.1, 0.1), (0, 0, 0.05 + gap_m)), GROUND).gaps) == 0


def test_meshes_without_faces_touch_nothing():
    nothing = Mesh(np.zeros((1, 3)), np.empty((0, 3), dtype=np.int32))
    assert len(touching(nothing, GROUND).gaps) == 0


def test_a_plate_on_a_post_touches_the_posts_corners():
    found = touching(box((1.0, 1.0, 0.1), (0.0, 0.0, 0.15)), box((0.2, 0.2, 0.2)))
    assert rows(found.points) == {(x, y, 0.1) for x in (-0.1, 0.1) for y in (-0.1, 0.1)}
    assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)))


@pytest.mark.parametrize("gap_m", [0.0, 3e-5, -3e-5])
def test_a_plank_across_another_touches_it_where_their_edges_cross(gap_m):
    found = touching(box((1.0, 0.1, 0.1), (0.0, 0.0, 0.1 + gap_m), rotation_about(UP, np.pi / 2)), box((1.0, 0.1, 0.1)))
    assert rows(found.points[:, :2]) == {(x, y) for x in (-0.05, 0.05) for y in (-0.05, 0.05)}
    assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)), abs=1e-9)
    assert found.gaps == pytest.approx(gap_m, abs=1e-12)


@pytest.mark.parametrize("gap_m", [2e-5, -2e-5])
def test_two_edges_across_one_another_touch_in_one_point(gap_m):
    """Square bars on their edges, one along x and one along y."""
    along_x = box(
        (0.3, 0.02, 0.02), (0, 0, 0.02 * np.sqrt(0.5) + gap_m), rotation_about(np.array([1.0, 0, 0]), np.pi / 4)
    )
    along_y = box((0.02, 0.3, 0.02), (0, 0, -0.02 * np.sqrt(0.5)), tipped(np.pi / 4))
    found = touching(along_x, along_y)
    assert found.points == pytest.approx(np.array([[0, 0, gap_m / 2]]), abs=1e-9)
    assert found.normals == pytest.approx(UP[None, :], abs=1e-9)
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
            assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)), abs=1e-9)


@pytest.mark.parametrize("x", [0.48, 0.45])
def test_over_the_edge_of_a_table_edges_touch_where_they_cross(x):
    """And a corner that lies on the edge touches the top, not the side."""
    found = touching(box((0.1, 0.1, 0.1), (x, 0, 0.05)), GROUND)
    assert found.points[:, 0].max() == pytest.approx(0.5)
    assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)), abs=1e-9)


def test_a_corner_leaves_a_body_the_shorter_way():
    """A tip 0.02 mm below the top and 0.04 mm inside the side: 0.02 mm up is the way out."""
    turn = tipped(0.5) @ rotation_about(np.array([1.0, 0, 0]), 0.5)
    tip = box((0.1, 0.1, 0.1), (0, 0, 0), turn)
    low = tip.vertices[np.argmin(tip.vertices[:, 2])]
    tip = Mesh(tip.vertices - low + [0.5 - 4e-5, 0, -2e-5], tip.faces)
    found = touching(tip, GROUND)
    assert found.gaps.min() == pytest.approx(-2e-5, abs=1e-12)
    assert found.normals[np.argmin(found.gaps)] == pytest.approx(UP)


def test_a_thin_plate_is_not_left_through_its_other_side():
    plate = box((0.2, 0.2, 1e-4), (0, 0, 5e-5))
    found = touching(plate, GROUND, DEEPEST_M)
    assert found.gaps == pytest.approx(0.0, abs=1e-12)
    assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)))


def test_a_ring_hangs_on_a_peg():
    """A square ring over a square bar: its concave side bears it."""
    ring = trimesh.boolean.difference([trimesh.creation.box((0.1, 0.02, 0.1)), trimesh.creation.box((0.08, 0.1, 0.08))])
    found = touching(mesh_of(ring), box((0.01, 0.2, 0.01), (0.0, 0.0, 0.035)))
    assert found.points[:, 2] == pytest.approx(0.04, abs=1e-9)
    assert found.normals == pytest.approx(np.tile(UP, (len(found.gaps), 1)), abs=1e-9)


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


def test_of_three_bodies_each_pair_that_touches_has_its_numbers():
    low, high = box((0.1, 0.1, 0.1), (0, 0, 0.05)), box((0.05, 0.05, 0.05), (0, 0, 0.125))
    found = contacts_between([low, high, GROUND], WITHIN_M)
    assert {(int(a), int(b)) for a, b in zip(found.upper, found.lower, strict=True)} == {(0, 1), (0, 2)}
    assert found.normals[found.lower == 1] == pytest.approx(np.tile(-UP, (int((found.lower == 1).sum()), 1)))
    assert found.of(1).sum() == (found.lower == 1).sum() and found.of(0).all()


def test_a_body_of_a_thousand_facets_in_any_pose_has_its_lowest_corner_as_its_gap():
    rng = np.random.default_rng(5)
    ball = trimesh.creation.icosphere(3, 0.05)
    for _ in range(10):
        at = mesh_of(ball, pose(uniform_rotation(rng), np.zeros(3)))
        lowest = at.vertices[:, 2].min()
        found = touching(Mesh(at.vertices + np.array([0, 0, 1e-5 - lowest]), at.faces), GROUND)
        assert found.gaps.min() == pytest.approx(1e-5, abs=1e-12)
