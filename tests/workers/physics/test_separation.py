"""How near objects come, against distances worked out by hand and by separating axes."""

import itertools
import math

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.kit.contacts import mesh_of
from tests.kit.shapes import box
from workers.geometry.frames import pose, rotation_about, translation, uniform_rotation
from workers.physics.placement import FARTHEST_M, Form, find_gaps_m, find_overlaps_m

CUBE = Form(mesh_of(box(0.1, 0.1, 0.1)))
GROUND = Form(mesh_of(box(2.0, 2.0, 0.1, (0, 0, -0.05))))


def gaps(*placed: tuple[Form, np.ndarray]) -> list[float]:
    return find_gaps_m([form for form, _ in placed], [T for _, T in placed])


def gap(one: Form, T_one, other: Form, T_other) -> float:
    """Of two, who are told the same."""
    a, b = gaps((one, T_one), (other, T_other))
    assert a == b
    return a


@pytest.mark.parametrize("gap_m", [1e-5, 0.003, 0.0099, -1e-5, -0.002, -0.03])
@pytest.mark.parametrize("axis", range(3))
def test_two_boxes_are_as_near_or_as_deep_as_they_were_put(axis, gap_m):
    away = translation(*(np.eye(3)[axis] * (0.1 + gap_m)))
    assert gap(CUBE, np.eye(4), CUBE, away) == pytest.approx(gap_m, abs=1e-9)


def test_two_edges_across_one_another_are_as_near_as_their_heights():
    """A cube on its edge along x over one on its edge along y."""
    low = pose(rotation_about(np.array([0.0, 1, 0]), math.pi / 4), np.zeros(3))
    up = np.array([0.0, 0.0, 0.1 * math.sqrt(2.0) + 0.004])
    high = pose(rotation_about(np.array([1.0, 0, 0]), math.pi / 4), up)
    assert gap(CUBE, low, CUBE, high) == pytest.approx(0.004, abs=1e-9)


def test_a_box_over_the_edge_of_a_table_is_as_high_as_its_part_above_the_top():
    """Turned about y, its lowest corner 10 mm beyond the edge at 1 m: what is over the edge is higher by the slope."""
    lean = 0.1
    R = rotation_about(np.array([0.0, 1.0, 0.0]), lean)
    corner = R @ np.array([0.05, 0.0, -0.05])
    for gap_m in (0.004, -0.003):
        z = gap_m * math.cos(lean) + (0.01 - gap_m * math.sin(lean)) * math.tan(-lean) - corner[2]
        found = gap(CUBE, pose(R, np.array([1.01 - corner[0], 0.0, z])), GROUND, np.eye(4))
        assert found == pytest.approx(gap_m * math.cos(lean), rel=0.02)


def test_what_is_further_than_is_looked_at_is_as_far_as_that():
    assert gap(CUBE, np.eye(4), CUBE, translation(0.2, 0.0, 0.0)) == FARTHEST_M


@pytest.mark.parametrize("seed", range(12))
def test_no_two_tilted_boxes_are_apart_where_no_axis_separates_them_nor_the_other_way_round(seed):
    """Two convex bodies are apart if and only if one of their normals, or of their edges' products, separates them."""
    rng = np.random.default_rng(seed)
    turns = [uniform_rotation(rng) for _ in range(2)]
    poses = [pose(turns[0], np.zeros(3)), pose(turns[1], rng.uniform(-0.1, 0.1, 3))]
    a, b = (CUBE.mesh.vertices @ T[:3, :3].T + T[:3, 3] for T in poses)
    axes = [*turns[0].T, *turns[1].T, *(np.cross(u, v) for u, v in itertools.product(turns[0].T, turns[1].T))]
    apart = [
        max(float((b @ n).min() - (a @ n).max()), float((a @ n).min() - (b @ n).max()))
        for n in (axis / np.linalg.norm(axis) for axis in axes)
    ]
    found = gap(CUBE, poses[0], CUBE, poses[1])
    if max(apart) > 0.0:
        assert found >= min(max(apart), FARTHEST_M) - 1e-9  # no less than along any axis
    else:
        assert -0.1 <= found < 0.0


def test_a_ball_in_a_hollow_is_as_near_as_the_radii_leave_it():
    """A hollow half ball of 50 mm, a ball of 20 mm put 27 mm below its centre: 3 mm are left, but for the facets."""
    outer = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    block = trimesh.boolean.difference([box(0.14, 0.14, 0.06, (0, 0, -0.03)), outer], engine="manifold")
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.02)
    found = gap(Form(mesh_of(block)), np.eye(4), Form(mesh_of(ball)), translation(0.0, 0.0, -0.027))
    assert found == pytest.approx(0.003, abs=5e-5)


def test_each_object_is_told_of_what_is_nearest_to_it():
    found = gaps(
        (CUBE, translation(0, 0, 0.051)),  # 1 mm over the ground, 2 mm below the next
        (CUBE, translation(0, 0, 0.153)),
        (CUBE, translation(0.099, 0, 0.154)),  # 1 mm deep in the second
        (CUBE, translation(0.5, 0, 0.0495)),  # in the ground
        (CUBE, translation(-0.5, 0, 0.3)),  # alone in the air
        (GROUND, np.eye(4)),
    )
    assert found == pytest.approx([0.001, -0.001, -0.001, -0.0005, FARTHEST_M, -0.0005], abs=1e-9)


@pytest.mark.parametrize("way", [1e-6, 3e-5, 4e-4])
def test_what_touches_the_side_of_a_wall_is_as_deep_in_it_as_it_reaches_and_not_as_the_wall_is_high(way):
    walled = trimesh.util.concatenate([box(2.0, 2.0, 0.1, (0, 0, -0.05)), box(0.02, 1.0, 0.3, (0.06, 0, 0.1))])
    """It touches the ground too: the piece that both share is bent, and up to three times as thick by its volume."""
    assert way <= -gap(CUBE, translation(way, 0, 0.05), Form(mesh_of(walled)), np.eye(4)) <= 3 * way


def test_what_encloses_no_body_is_as_deep_as_its_corners_and_edges_are():
    """An open box: in its hull, but not in its walls, which are without thickness."""
    cube = box(0.1, 0.1, 0.1)
    open_box = Form(
        Mesh(np.asarray(cube.vertices), np.asarray(cube.faces[cube.face_normals[:, 2] < 0.5], dtype=np.int32))
    )
    small = Form(mesh_of(box(0.02, 0.02, 0.02)))
    assert open_box.solid is None
    assert gap(small, translation(0, 0, -0.04 + 0.0005), open_box, np.eye(4)) == pytest.approx(0.0005, abs=1e-9)
    assert gap(small, translation(0, 0, -0.04 - 0.0005), open_box, np.eye(4)) == pytest.approx(-0.0005, abs=1e-9)


@pytest.mark.parametrize(("way", "expected"), [(0.098, 0.002), (0.1, 0.0), (0.11, 0.0), (3.0, 0.0)])
def test_an_overlap_is_the_depth_and_nothing_where_two_bodies_only_touch_or_are_apart(way, expected):
    depths = [depth for _, _, depth in find_overlaps_m([CUBE, CUBE], [np.eye(4), translation(0, way, 0)])]
    assert max(depths, default=0.0) == pytest.approx(expected, abs=1e-9)


def test_an_overlap_counts_the_hull_of_what_encloses_no_body():
    sheet = Form(Mesh(np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]), np.array([[0, 1, 2]], np.int32)))
    ((i, j, depth_m),) = find_overlaps_m([sheet, CUBE], [np.eye(4), np.eye(4)])
    assert (i, j) == (0, 1) and depth_m > 0.01
