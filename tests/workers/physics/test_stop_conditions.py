"""What may be left out of a simulation, and when it was wrong to."""

import math

import numpy as np
import pytest
import trimesh

from tests.shapes import box
from workers.geometry.frames import pose, quaternion_from_rotation, rotation_about, uniform_rotation
from workers.geometry.hull import convex_hull
from workers.physics.rest_pose import TIPPED_RAD, stands_on_face
from workers.physics.stop_conditions import (
    TOUCH_RAD,
    can_touch,
    falls_below,
    leaves_outline,
    leaves_room,
    tips_over,
)

DOWN = np.array([0.0, 0.0, -1.0])
SOLIDS = {
    "cylinder": trimesh.creation.cylinder(0.04, 0.2, sections=48),
    "cone": trimesh.creation.cone(0.05, 0.1, sections=32),
    "ball": trimesh.creation.icosphere(subdivisions=3, radius=0.06),
    "box": box(0.1, 0.08, 0.2),
}


def at(x: float, y: float, R=None):
    return (x, y, 0.0), tuple(quaternion_from_rotation(np.eye(3) if R is None else R))


@pytest.mark.parametrize("name", SOLIDS)
def test_no_vertex_is_left_out_that_is_lowest_at_some_lean(name):
    rng = np.random.default_rng(1)
    turn = uniform_rotation(rng)
    vertices = convex_hull(np.asarray(SOLIDS[name].vertices)).vertices @ turn.T
    down = turn @ DOWN
    kept = can_touch(vertices, down)
    for _ in range(2000):
        axis = rng.standard_normal(3)
        lean = rotation_about(axis / np.linalg.norm(axis), rng.uniform(0.0, TOUCH_RAD))
        assert kept[np.argmax(vertices @ (lean @ down))]


def test_of_a_cylinder_that_stands_only_its_lower_rim_is_kept():
    vertices = np.asarray(SOLIDS["cylinder"].vertices)
    rim = (vertices[:, 2] < 0) & (np.hypot(vertices[:, 0], vertices[:, 1]) > 0.03)
    kept = can_touch(vertices, DOWN)
    assert kept[rim].all()
    assert not kept[vertices[:, 2] > 0].any()


def test_a_box_stands_on_its_face_and_not_on_its_edge():
    vertices = convex_hull(np.asarray(SOLIDS["box"].vertices)).vertices
    assert stands_on_face(vertices, DOWN)
    assert not stands_on_face(vertices, rotation_about(np.array([0, 1.0, 0]), 0.3) @ DOWN)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_leaning_is_told_at_its_angle_whatever_the_yaw(yaw):
    R = uniform_rotation(np.random.default_rng(3))
    tips = tips_over(pose(R, np.zeros(3)))
    axis, turned = np.array([math.cos(0.7), math.sin(0.7), 0.0]), rotation_about(np.array([0, 0, 1.0]), yaw)
    assert not tips(at(0, 0, rotation_about(axis, TIPPED_RAD - 1e-3) @ turned @ R))
    assert tips(at(0, 0, rotation_about(axis, TIPPED_RAD + 1e-3) @ turned @ R))


def test_an_edge_is_near_where_the_nearest_one_is_within_reach():
    outline = np.array([[-0.5, -0.3], [0.9, -0.3], [0.9, 0.3], [-0.5, 0.3]])
    near = leaves_outline(outline, 0.1)
    rng = np.random.default_rng(0)
    for x, y in rng.uniform([-0.6, -0.4], [1.0, 0.4], (500, 2)):
        assert near(at(x, y)) == (min(x + 0.5, 0.9 - x, y + 0.3, 0.3 - y) < 0.1)


def test_a_room_is_a_circle_about_where_the_body_began_however_high_it_is():
    strays = leaves_room(np.array([0.3, -0.2]), 0.05)
    for way in (0.0, 1.0, 2.5, 4.0):
        for far, expected in ((0.0, False), (0.0499, False), (0.0501, True), (3.0, True)):
            x, y = 0.3 + far * math.cos(way), -0.2 + far * math.sin(way)
            assert strays(((x, y, 7.0 * way), at(0, 0)[1])) == expected
    assert not leaves_room(np.zeros(2), math.inf)(at(1e9, 1e9))


def test_what_is_gone_is_below_everything_that_it_could_land_on():
    gone = falls_below(-0.1)
    assert [gone(((5.0, 5.0, z), at(0, 0)[1])) for z in (0.0, -0.0999, -0.1001, -9.0)] == [False, False, True, True]
