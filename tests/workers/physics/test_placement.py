"""How near objects come, against distances worked out by hand and by separating axes.

How objects lie on a table and on one another, against what can be worked out by hand.
"""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import trimesh

from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import REGION_TABLE, Asset
from tests.kit.contacts import mesh_of
from tests.kit.shapes import asset_of, box, shape_of, table
from workers.geometry.frames import pose, rotation_about, translation, uniform_rotation
from workers.geometry.hull import convex_hull
from workers.physics.placement import (
    FARTHEST_M,
    Form,
    Support,
    find_gaps_m,
    find_overlaps_m,
    forms_of,
    measure_supports,
    place,
)
from workers.physics.support import place_table

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


def test_a_box_over_the_edge_of_a_table_is_as_high_as_its_part_above_the_top():
    """Turned about y, its lowest corner 10 mm beyond the edge at 1 m: what is over the edge is higher by the slope."""
    lean = 0.1
    R = rotation_about(np.array([0.0, 1.0, 0.0]), lean)
    corner = R @ np.array([0.05, 0.0, -0.05])
    for gap_m in (0.004, -0.003):
        z = gap_m * math.cos(lean) + (0.01 - gap_m * math.sin(lean)) * math.tan(-lean) - corner[2]
        found = gap(CUBE, pose(R, np.array([1.01 - corner[0], 0.0, z])), GROUND, np.eye(4))
        assert found == pytest.approx(gap_m * math.cos(lean), rel=0.02)


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


@pytest.mark.parametrize(("way", "expected"), [(0.098, 0.002), (0.1, 0.0), (0.11, 0.0), (3.0, 0.0)])
def test_an_overlap_is_the_depth_and_nothing_where_two_bodies_only_touch_or_are_apart(way, expected):
    depths = [depth for _, _, depth in find_overlaps_m([CUBE, CUBE], [np.eye(4), translation(0, way, 0)])]
    assert max(depths, default=0.0) == pytest.approx(expected, abs=1e-9)


Y = np.array([0.0, 1.0, 0.0])
FRICTION = 0.5
G = 9.81


def start_of(asset: Asset, region: int = 3) -> ObjectStart:
    return ObjectStart(asset, convex_hull(asset.shape.vertices), region, np.eye(4), 0, False)


STARTED_CUBE = start_of(asset_of(box(0.1, 0.1, 0.1)))
TABLE = place_table(table())
TOP = TABLE.top.height_m
HOOK = start_of(asset_of(box(0.02, 0.02, 0.1, (-0.03, 0, -0.05)), box(0.08, 0.02, 0.02, (0, 0, 0.01))))
"""An L upside down: a bar that lies on something, 80 mm long, and a leg down from its end, whose inner side is at -20 mm."""


def held(start: ObjectStart, T: np.ndarray, on: Table = TABLE, friction: float = FRICTION) -> Support:
    return measure_supports(place([start], [T], forms_of([start]), on, friction), [T])[0]


def test_a_box_on_a_level_is_held_with_a_margin_of_half_its_side():
    support = held(STARTED_CUBE, translation(0.1, 0.0, TOP + 0.05))
    assert support.margin_m == pytest.approx(0.05, abs=1e-9)
    assert support.unbalanced < 1e-9
    assert support.gap_m == pytest.approx(0.0, abs=1e-9)


def test_the_forces_on_a_box_carry_its_weight_from_corners_of_its_face():
    support = held(STARTED_CUBE, translation(0.1, 0.0, TOP + 0.05))
    forces = np.array([contact.force for contact in support.forces])
    assert forces.sum(axis=0) == pytest.approx([0, 0, STARTED_CUBE.asset.mass.mass_kg * G], abs=1e-9)
    for contact in support.forces:
        assert contact.with_region == REGION_TABLE
        assert np.abs(contact.point - [0.1, 0.0, TOP]) == pytest.approx([0.05, 0.05, 0.0], abs=1e-9)
        assert contact.normal == pytest.approx([0, 0, 1])


def test_of_two_each_has_the_others_force_turned_round():
    starts = [STARTED_CUBE, start_of(asset_of(box(0.05, 0.05, 0.05)), 4)]
    poses = [translation(0, 0, TOP + 0.05), translation(0.01, 0, TOP + 0.125)]
    low, high = measure_supports(place(starts, poses, forms_of(starts), TABLE, FRICTION), poses)
    down = np.array([contact.force for contact in low.forces if contact.with_region == 4]).sum(axis=0)
    up = np.array([contact.force for contact in high.forces if contact.with_region == 3]).sum(axis=0)
    assert up == pytest.approx(-down) and up[2] == pytest.approx(starts[1].asset.mass.mass_kg * G)
    assert max(low.unbalanced, high.unbalanced) < 1e-9
    assert (low.margin_m, high.margin_m) == pytest.approx((0.05, 0.025), abs=1e-9)


def test_a_hook_hangs_where_its_centre_of_mass_is_over_the_top_and_not_where_it_is_beyond():
    """Of bar (1.28 parts at 0) and leg (1.6 parts at -30 mm) the centre is at -16.7 mm."""
    hangs = translation(-0.7 + 0.02, 0.0, TOP)  # the leg at the slab's side: the centre 3.3 mm inside
    falls = translation(-0.7 + 0.005, 0.0, TOP)
    centre = HOOK.asset.mass.com[0]
    assert held(HOOK, hangs).margin_m == pytest.approx(0.02 + centre, abs=1e-6)
    assert held(HOOK, hangs).unbalanced < 1e-6
    assert held(HOOK, falls).margin_m == pytest.approx(0.005 + centre, abs=1e-6)
    assert held(HOOK, falls).unbalanced > 0.01


def test_a_steep_slope_holds_a_box_only_by_friction():
    """tan 2 degrees is 0.035."""
    lean = math.radians(2.0)
    slab = box(1.4, 1.4, 0.03, (0, 0, -0.015)).apply_transform(pose(rotation_about(Y, lean), np.zeros(3)))
    slope = place_table(dataclasses.replace(table(), shape=shape_of(slab)))
    normal = rotation_about(Y, lean) @ [0.0, 0.0, 1.0]
    middle = slope.mesh.vertices[slope.mesh.vertices @ normal > (slope.mesh.vertices @ normal).max() - 1e-9].mean(
        axis=0
    )
    T = pose(rotation_about(Y, lean), middle + 0.05 * normal)
    assert held(STARTED_CUBE, T, slope, 0.05).unbalanced < 1e-6
    assert held(STARTED_CUBE, T, slope, 0.02).unbalanced > 0.01
