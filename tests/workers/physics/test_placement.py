"""How an object lies on a table, against what can be worked out by hand."""

import dataclasses
import math

import numpy as np
import pytest

from schemas.scene.plan import ObjectStart, Table
from schemas.scene.shape import Asset
from tests.shapes import asset_of, box, shape_of, table
from workers.geometry.frames import pose, rotation_about, transform, translation
from workers.geometry.hull import convex_hull
from workers.physics.placement import HOOKED_M, Ground, gap_m, ground_of, placed_mesh, support_of, touch_down
from workers.physics.rest_pose import CONTACT_M
from workers.physics.separation import NEAR_M
from workers.physics.table_top import place_table

Y = np.array([0.0, 1.0, 0.0])
FRICTION = 0.5
SLOPE_RAD = math.radians(2.0)


def start_of(asset: Asset) -> ObjectStart:
    return ObjectStart(asset, convex_hull(asset.shape.vertices), 3, np.eye(4), 0, False)


def table_of(*meshes) -> Table:
    return place_table(dataclasses.replace(table(), shape=shape_of(*meshes)))


def sloping() -> Table:
    """A slab that falls towards +x by `SLOPE_RAD`, its upper side through the world's z axis at its middle's height."""
    return table_of(
        box(1.4, 1.4, 0.03, (0, 0, -0.015)).apply_transform(pose(rotation_about(Y, SLOPE_RAD), np.zeros(3)))
    )


CUBE = start_of(asset_of(box(0.1, 0.1, 0.1)))
LEVEL = ground_of(place_table(table()))
TOP = LEVEL.table.top.height_m
HOOK = start_of(asset_of(box(0.02, 0.02, 0.1, (-0.03, 0, -0.05)), box(0.08, 0.02, 0.02, (0, 0, 0.01))))
"""An L upside down: a bar that lies on something, 80 mm long, and a leg down from its end, whose inner side is at -20 mm."""


def hooked(gap: float) -> np.ndarray:
    """The hook on the table's edge at -0.7 m: its leg hangs 5 mm off the slab's side, its bar `gap` above the top."""
    return translation(-0.7 - 0.005 + 0.02, 0.0, TOP + gap)


@pytest.mark.parametrize("gap", [0.004, 1e-6, -1e-6, -0.003])
def test_the_gap_of_a_box_over_a_level_is_its_height_over_it(gap):
    assert gap_m(CUBE, translation(0.1, 0.2, TOP + 0.05 + gap), LEVEL) == pytest.approx(gap, abs=1e-12)


@pytest.mark.xfail(reason="of two edges that cross nothing is told: the box lies 9 mm deeper", raises=AssertionError)
@pytest.mark.parametrize("gap", [0.004, -0.003])
def test_the_gap_of_a_box_that_reaches_over_the_edge_is_that_of_its_part_above_the_top(gap):
    """Turned about y, its lowest corner beyond the edge: what is over the edge at 0.7 m is higher by the slope."""
    lean = 0.1
    R = rotation_about(Y, lean)
    corner = R @ np.array([0.05, 0.0, -0.05])
    x = 0.71 - corner[0]  # 10 mm beyond
    z = TOP + gap + 0.01 * math.tan(-lean) - corner[2]
    assert gap_m(CUBE, pose(R, np.array([x, 0.0, z])), LEVEL) == pytest.approx(gap, abs=1e-9)


@pytest.mark.parametrize("gap", [0.002, -0.002])
def test_the_gap_over_a_slope_is_told_along_z_above_its_highest_point_under_the_box(gap):
    slab = ground_of(sloping())
    highest = float(transform(np.eye(4), slab.table.mesh.vertices)[:, 2].max())
    x_highest = slab.table.mesh.vertices[np.argmax(slab.table.mesh.vertices[:, 2]), 0]
    below = highest - (-0.05 - x_highest) * math.tan(SLOPE_RAD)  # under the box's side at -50 mm
    assert gap_m(CUBE, translation(0.0, 0.0, below + 0.05 + gap), slab) == pytest.approx(gap, abs=1e-9)


def test_beside_the_table_there_is_no_gap():
    assert gap_m(CUBE, translation(2.0, 0.0, TOP + 0.05), LEVEL) == math.inf
    assert gap_m(CUBE, translation(2.0, 0.0, TOP), LEVEL) == NEAR_M  # lower, where it may be hooked: no less than that


@pytest.mark.parametrize("height", [0.02, -0.004])
def test_what_is_set_down_touches_wherever_it_was(height):
    R = rotation_about(Y, 0.3) @ rotation_about(np.array([1.0, 0, 0]), 0.2)
    T = pose(R, np.array([0.1, 0.1, TOP + 0.05 + height]))
    down = touch_down(CUBE, T, LEVEL)
    assert placed_mesh(CUBE, down).vertices[:, 2].min() == pytest.approx(TOP, abs=1e-12)
    assert down[:2, 3] == pytest.approx(T[:2, 3])
    assert np.array_equal(down[:3, :3], R)


@pytest.mark.parametrize("gap", [0.0035, 0.0004, -0.0015])
def test_the_gap_of_what_is_hooked_on_the_edge_is_the_least_distance_of_two_bodies(gap):
    """Its leg is nearer to the slab's side, 5 mm, than the level below it on the floor: along z it would be 0.7 m."""
    assert placed_mesh(HOOK, hooked(gap)).vertices[:, 2].min() < TOP - HOOKED_M
    assert gap_m(HOOK, hooked(gap), LEVEL) == pytest.approx(gap, abs=1e-9)


def test_what_is_hooked_is_lowered_until_it_hangs():
    down = touch_down(HOOK, hooked(0.0035), LEVEL)
    assert abs(down[2, 3] - TOP) <= CONTACT_M
    assert down[:2, 3] == pytest.approx(hooked(0.0)[:2, 3])


def test_what_is_hooked_to_nothing_is_left_where_it_is():
    T = hooked(0.02) @ translation(-0.035, 0.0, 0.0)  # its leg is 40 mm off
    assert np.array_equal(touch_down(HOOK, T, LEVEL), T)


@pytest.mark.parametrize("deep_m", [1e-6, 3e-5])
def test_what_touches_a_wall_is_not_lifted_onto_it(deep_m):
    walled = ground_of(table_of(box(1.4, 1.4, 0.03, (0, 0, -0.015)), box(0.02, 1.4, 0.15, (0.69, 0, 0.075))))
    T = translation(0.68 - 0.05 + deep_m, 0.0, walled.table.top.height_m + 0.05)
    assert gap_m(CUBE, T, walled) == pytest.approx(-deep_m, abs=2e-7)
    lifted = translation(0.0, 0.0, 0.002) @ T
    for begun in (T, lifted):
        assert touch_down(CUBE, begun, walled) == pytest.approx(T, abs=1e-9)
    assert support_of(CUBE, T, walled, FRICTION).residual < 1e-6


def held(start: ObjectStart, T: np.ndarray, ground: Ground = LEVEL):
    return support_of(start, T, ground, FRICTION)


def test_a_box_on_a_level_is_held_with_a_margin_of_half_its_side():
    support = held(CUBE, translation(0.1, 0.0, TOP + 0.05))
    assert support.margin_m == pytest.approx(0.05, abs=1e-9)
    assert support.residual < 1e-9
    assert support.highest_m == pytest.approx(TOP, abs=1e-9)


@pytest.mark.parametrize("beyond_m", [-0.01, 0.01])
def test_a_box_over_the_edge_is_held_while_its_centre_is_over_the_top(beyond_m):
    """Beyond, the moment that is left is its weight times the way: over its weight and its size, way / 0.1 m."""
    support = held(CUBE, translation(0.7 + beyond_m, 0.0, TOP + 0.05))
    assert support.margin_m == pytest.approx(-beyond_m, abs=1e-9)
    if beyond_m < 0.0:
        assert support.residual < 1e-9
    else:  # less than all of it, because a force that is too small leaves less of the moment
        assert 0.5 * beyond_m / 0.1 < support.residual <= beyond_m / 0.1


def test_a_hook_hangs_where_its_centre_of_mass_is_over_the_top_and_not_where_it_is_beyond():
    """Of bar (1.28 parts at 0) and leg (1.6 parts at -30 mm) the centre is at -16.7 mm."""
    hangs = translation(-0.7 + 0.02, 0.0, TOP)  # the leg at the slab's side: the centre 3.3 mm inside
    falls = translation(-0.7 + 0.005, 0.0, TOP)
    centre = HOOK.asset.mass.com[0]
    assert held(HOOK, hangs).margin_m == pytest.approx(0.02 + centre, abs=1e-6)
    assert held(HOOK, hangs).residual < 1e-6
    assert held(HOOK, falls).margin_m == pytest.approx(0.005 + centre, abs=1e-6)
    assert held(HOOK, falls).residual > 0.05


def test_what_only_touches_a_side_is_not_held_up_by_it():
    """The force mu n up and n sideways that is nearest to the weight leaves 1 / sqrt(1 + mu^2) of it."""
    support = held(CUBE, translation(0.75, 0.0, TOP - 0.02))
    assert support.residual == pytest.approx(1.0 / math.sqrt(1.0 + FRICTION**2), rel=1e-3)
    assert support.margin_m == pytest.approx(-0.1)
    assert support.highest_m == pytest.approx(TOP, abs=1e-6)  # though there are contacts


def test_nothing_is_held_in_the_air():
    support = held(CUBE, translation(0.0, 0.0, TOP + 0.06))
    assert (support.residual, support.highest_m) == (1.0, -math.inf)
    assert support.margin_m == pytest.approx(-0.1)  # its size


def test_a_steep_slope_holds_a_box_only_by_friction():
    """tan 2 degrees is 0.035."""
    slab = ground_of(sloping())
    T = touch_down(CUBE, pose(rotation_about(Y, SLOPE_RAD), np.array([0.0, 0.0, 1.0])), slab)
    assert support_of(CUBE, T, slab, 0.05).residual < 1e-6
    assert support_of(CUBE, T, slab, 0.02).residual > 0.01
