"""What ends a simulation early: what leaves, and what stands by the energy that it takes to tip and what friction takes up."""

import dataclasses
import math

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart
from tests.hard_cases.drops import X, turn
from tests.shapes import asset_of, box, table
from workers.geometry.frames import pose, quaternion_from_rotation
from workers.geometry.hull import convex_hull
from workers.physics.bullet import GRAVITY_M_S2
from workers.physics.energy import LIFT_M
from workers.physics.release import PACES, Drop, release
from workers.physics.rigid_body import body_frame, make_body
from workers.physics.stop_conditions import SLIDE_M, falls_below, leaves_outline, leaves_room, stays_standing
from workers.physics.table_top import place_table

TOP_M, FRICTION = 0.7, 0.49
STILL = (0.0, 0.0, 0.0)
PHYSICS = Job(name="t").physics


def start_of(x: float, y: float, z: float, up_m: float = 0.0, R=None) -> ObjectStart:
    asset = asset_of(box(x, y, z))
    return ObjectStart(
        asset,
        convex_hull(asset.shape.vertices),
        3,
        pose(np.eye(3) if R is None else R, np.array([0, 0, TOP_M + z / 2 + up_m])),
        0,
        False,
    )


def stands(start: ObjectStart, v=STILL, w=STILL, friction: float = FRICTION) -> bool:
    T = start.T_world_obj @ body_frame(start.asset.mass)[0]
    at = (tuple(T[:3, 3].tolist()), tuple(quaternion_from_rotation(T[:3, :3]).tolist()))
    return stays_standing(start, make_body(start), TOP_M, friction)(at, (v, w))


def test_a_box_at_rest_on_a_face_stays():
    assert stands(start_of(0.1, 0.08, 0.2))


@pytest.mark.parametrize("friction", [0.1, 0.49])
def test_what_would_slide_further_than_the_bound_does_not_count_as_standing(friction):
    """Friction brakes by mu g: the way is v^2 / (2 mu g)."""
    speed = math.sqrt(2.0 * friction * GRAVITY_M_S2 * SLIDE_M)
    box_ = start_of(0.1, 0.08, 0.2)
    assert stands(box_, v=(0.99 * speed, 0.0, 0.0), friction=friction)
    assert not stands(box_, v=(1.01 * speed, 0.0, 0.0), friction=friction)
    assert not stands(box_, v=(1e-6, 0.0, 0.0), friction=0.0)


def test_turning_counts_by_the_moment_of_inertia():
    side = 0.1
    spin = math.sqrt(2.0 * FRICTION * GRAVITY_M_S2 * SLIDE_M / (side * side / 6.0))
    assert stands(start_of(side, side, side), w=(0.0, 0.0, 0.99 * spin))
    assert not stands(start_of(side, side, side), w=(0.0, 0.0, 1.01 * spin))


@pytest.mark.parametrize("width", [0.01, 0.02])
def test_what_has_the_energy_to_tip_over_its_nearest_edge_does_not_count_as_standing(width):
    """The centre of mass rises from h to the root of h^2 and the half width squared."""
    height = 0.1
    barrier_m = math.hypot(height, width) / 2.0 - height / 2.0
    assert stands(start_of(width, 0.05, height, up_m=0.99 * (barrier_m - LIFT_M)))
    assert not stands(start_of(width, 0.05, height, up_m=1.01 * (barrier_m - LIFT_M)))


def test_a_needle_on_its_end_and_a_box_off_its_faces_do_not_count_as_standing():
    assert not stands(start_of(0.002, 0.002, 0.2))
    assert not stands(start_of(0.1, 0.08, 0.2, R=turn(X, 3)))


def test_a_drop_ends_sooner_where_the_object_stands_and_as_it_would_have():
    table_ = place_table(table())
    T = start_of(0.1, 0.08, 0.2).T_world_obj.copy()
    T[2, 3] = table_.top.height_m + 0.1 + 0.01
    start = dataclasses.replace(start_of(0.1, 0.08, 0.2), T_world_obj=T)
    plan = EffectPlan(("dynamics", "fine_step"), {})
    drop = Drop((start,), table_, PHYSICS, plan, pace=PACES[0])
    sooner = release(drop, flat=True)
    later = release(dataclasses.replace(drop, physics=PHYSICS.model_copy(update={"exact_rest": False})), flat=True)
    assert sooner.rested and sooner.seconds < later.seconds - PHYSICS.rest.window_s / 2
    assert sooner.poses[0][:2, 3] == pytest.approx(later.poses[0][:2, 3], abs=3e-6)


def fallen_at(x: float, y: float, R=None):
    return (x, y, 0.0), tuple(quaternion_from_rotation(np.eye(3) if R is None else R))


def test_an_edge_is_near_where_the_nearest_one_is_within_reach():
    outline = np.array([[-0.5, -0.3], [0.9, -0.3], [0.9, 0.3], [-0.5, 0.3]])
    near = leaves_outline(outline, 0.1)
    rng = np.random.default_rng(0)
    for x, y in rng.uniform([-0.6, -0.4], [1.0, 0.4], (500, 2)):
        assert near(0, fallen_at(x, y)) == (min(x + 0.5, 0.9 - x, y + 0.3, 0.3 - y) < 0.1)


def test_a_room_is_a_circle_about_where_the_body_began_however_high_it_is():
    strays = leaves_room(np.array([0.3, -0.2]), 0.05)
    for way in (0.0, 1.0, 2.5, 4.0):
        for far, expected in ((0.0, False), (0.0499, False), (0.0501, True), (3.0, True)):
            x, y = 0.3 + far * math.cos(way), -0.2 + far * math.sin(way)
            assert strays(0, ((x, y, 7.0 * way), fallen_at(0, 0)[1])) == expected
    assert not leaves_room(np.zeros(2), math.inf)(0, fallen_at(1e9, 1e9))


def test_what_is_gone_is_below_everything_that_it_could_land_on():
    gone = falls_below(-0.1)
    assert [gone(0, ((5.0, 5.0, z), fallen_at(0, 0)[1])) for z in (0.0, -0.0999, -0.1001, -9.0)] == [
        False,
        False,
        True,
        True,
    ]
