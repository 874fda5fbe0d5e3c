"""How objects lie on a table and on one another, against what can be worked out by hand."""

import dataclasses
import math

import numpy as np
import pytest

from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import REGION_TABLE, Asset
from tests.kit.shapes import asset_of, box, shape_of, table
from workers.geometry.frames import pose, rotation_about, translation
from workers.geometry.hull import convex_hull
from workers.physics.placement import (
    FARTHEST_M,
    Support,
    forms_of,
    measure_supports,
    place,
    place_on_top,
    placed_mesh,
)
from workers.physics.support import place_table

Y = np.array([0.0, 1.0, 0.0])
FRICTION = 0.5
G = 9.81


def start_of(asset: Asset, region: int = 3) -> ObjectStart:
    return ObjectStart(asset, convex_hull(asset.shape.vertices), region, np.eye(4), 0, False)


CUBE = start_of(asset_of(box(0.1, 0.1, 0.1)))
TABLE = place_table(table())
TOP = TABLE.top.height_m
HOOK = start_of(asset_of(box(0.02, 0.02, 0.1, (-0.03, 0, -0.05)), box(0.08, 0.02, 0.02, (0, 0, 0.01))))
"""An L upside down: a bar that lies on something, 80 mm long, and a leg down from its end, whose inner side is at -20 mm."""


def held(start: ObjectStart, T: np.ndarray, on: Table = TABLE, friction: float = FRICTION) -> Support:
    return measure_supports(place([start], [T], forms_of([start]), on, friction), [T])[0]


def test_a_box_on_a_level_is_held_with_a_margin_of_half_its_side():
    support = held(CUBE, translation(0.1, 0.0, TOP + 0.05))
    assert support.margin_m == pytest.approx(0.05, abs=1e-9)
    assert support.unbalanced < 1e-9
    assert support.gap_m == pytest.approx(0.0, abs=1e-9)


def test_the_forces_on_a_box_carry_its_weight_from_corners_of_its_face():
    support = held(CUBE, translation(0.1, 0.0, TOP + 0.05))
    forces = np.array([contact.force for contact in support.forces])
    assert forces.sum(axis=0) == pytest.approx([0, 0, CUBE.asset.mass.mass_kg * G], abs=1e-9)
    for contact in support.forces:
        assert contact.with_region == REGION_TABLE
        assert np.abs(contact.point - [0.1, 0.0, TOP]) == pytest.approx([0.05, 0.05, 0.0], abs=1e-9)
        assert contact.normal == pytest.approx([0, 0, 1])


def test_of_two_each_has_the_others_force_turned_round():
    starts = [CUBE, start_of(asset_of(box(0.05, 0.05, 0.05)), 4)]
    poses = [translation(0, 0, TOP + 0.05), translation(0.01, 0, TOP + 0.125)]
    low, high = measure_supports(place(starts, poses, forms_of(starts), TABLE, FRICTION), poses)
    down = np.array([contact.force for contact in low.forces if contact.with_region == 4]).sum(axis=0)
    up = np.array([contact.force for contact in high.forces if contact.with_region == 3]).sum(axis=0)
    assert up == pytest.approx(-down) and up[2] == pytest.approx(starts[1].asset.mass.mass_kg * G)
    assert max(low.unbalanced, high.unbalanced) < 1e-9
    assert (low.margin_m, high.margin_m) == pytest.approx((0.05, 0.025), abs=1e-9)


@pytest.mark.parametrize("gap", [0.004, 1e-6, -1e-6, -0.003])
def test_the_gap_of_a_box_over_a_level_is_its_height_over_it(gap):
    T = translation(0.1, 0.2, TOP + 0.05 + gap)
    assert held(CUBE, T).gap_m == pytest.approx(gap, abs=1e-9)
    assert measure_supports(place_on_top(CUBE, T, TABLE, FRICTION), [T])[0].gap_m == pytest.approx(gap, abs=1e-9)


def test_by_its_underside_alone_it_rests_as_it_does_whole():
    T = translation(0.1, 0.2, TOP + 0.05)
    whole, under = held(CUBE, T), measure_supports(place_on_top(CUBE, T, TABLE, FRICTION), [T])[0]
    assert (under.margin_m, under.unbalanced) == pytest.approx((whole.margin_m, whole.unbalanced), abs=1e-9)


def test_beside_the_table_there_is_no_contact():
    support = held(CUBE, translation(2.0, 0.0, TOP + 0.05))
    assert (support.gap_m, support.forces) == (FARTHEST_M, ())


@pytest.mark.parametrize("beyond_m", [-0.01, 0.01])
def test_a_box_over_the_edge_is_held_while_its_centre_is_over_the_top(beyond_m):
    support = held(CUBE, translation(0.7 + beyond_m, 0.0, TOP + 0.05))
    assert support.margin_m == pytest.approx(-beyond_m, abs=1e-9)
    assert (support.unbalanced < 1e-9) if beyond_m < 0.0 else (support.unbalanced > 0.01)


def test_a_hook_hangs_where_its_centre_of_mass_is_over_the_top_and_not_where_it_is_beyond():
    """Of bar (1.28 parts at 0) and leg (1.6 parts at -30 mm) the centre is at -16.7 mm."""
    hangs = translation(-0.7 + 0.02, 0.0, TOP)  # the leg at the slab's side: the centre 3.3 mm inside
    falls = translation(-0.7 + 0.005, 0.0, TOP)
    centre = HOOK.asset.mass.com[0]
    assert held(HOOK, hangs).margin_m == pytest.approx(0.02 + centre, abs=1e-6)
    assert held(HOOK, hangs).unbalanced < 1e-6
    assert held(HOOK, falls).margin_m == pytest.approx(0.005 + centre, abs=1e-6)
    assert held(HOOK, falls).unbalanced > 0.01


def test_what_only_touches_a_side_is_not_held_up_by_it():
    support = held(CUBE, translation(0.75, 0.0, TOP - 0.02))
    assert support.unbalanced > 0.5
    assert support.margin_m == pytest.approx(-0.1)  # its size


def test_nothing_is_held_in_the_air():
    support = held(CUBE, translation(0.0, 0.0, TOP + 0.06))
    assert support.unbalanced == pytest.approx(1.0)
    assert support.margin_m == pytest.approx(-0.1)


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
    assert held(CUBE, T, slope, 0.05).unbalanced < 1e-6
    assert held(CUBE, T, slope, 0.02).unbalanced > 0.01


def test_a_mesh_is_where_it_was_put():
    assert placed_mesh(CUBE, translation(1.0, 2.0, 3.0)).vertices.mean(axis=0) == pytest.approx([1.0, 2.0, 3.0])


def test_some_of_the_objects_lie_on_the_same_table():
    starts = [CUBE, HOOK, start_of(asset_of(box(0.05, 0.05, 0.05)), region=5)]
    whole = place(starts, [translation(0.0, 0.0, TOP + 1.0)] * 3, forms_of(starts), TABLE, FRICTION)
    few = whole.of([2, 0])
    assert few.starts == (starts[2], CUBE) and few.things == (whole.things[2], whole.things[0])
    assert few.forms == (whole.forms[2], whole.forms[0], whole.forms[3]) and few.friction == FRICTION
    assert few.surfaces == tuple(form.surface for form in few.forms)
