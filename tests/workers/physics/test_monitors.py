"""The energy of a falling body, against closed forms; what ends its fall early: what leaves, and what stands."""

import dataclasses
import math

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart
from tests.hard_cases.drops import X, turn
from tests.kit.shapes import asset_of, box, table
from workers.geometry.frames import pose, quaternion_from_rotation, uniform_rotation
from workers.geometry.hull import convex_hull
from workers.physics.bullet import GRAVITY_M_S2
from workers.physics.fall import (
    LIFT_M,
    SHARE,
    SLIDE_M,
    EnergyRecord,
    falls_below,
    leaves_outline,
    stays_standing,
    strays,
)
from workers.physics.release import PACES, Drop, release
from workers.physics.rigid_body import Body, body_frame, make_body
from workers.physics.support import place_table

TOP_M, FRICTION = 0.7, 0.49
STILL = (0.0, 0.0, 0.0)
AT_REST = (STILL, STILL)
PHYSICS = Job(name="t").physics
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
BODY = Body(2.0, np.array([1e-3, 2e-3, 4e-3]), (np.zeros((1, 3)),))


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
    return stays_standing(start, make_body(start), TOP_M, friction)(at, (v, w)) is not None


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
    drop = Drop((start,), table_, PHYSICS, plan)
    sooner = release(drop, True, PACES)
    later = release(dataclasses.replace(drop, physics=PHYSICS.model_copy(update={"exact_rest": False})), True, PACES)
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
    leaves = strays(np.array([[0.3, -0.2]]), 0.05)
    for way in (0.0, 1.0, 2.5, 4.0):
        for far, expected in ((0.0, False), (0.0499, False), (0.0501, True), (3.0, True)):
            x, y = 0.3 + far * math.cos(way), -0.2 + far * math.sin(way)
            assert leaves(0, ((x, y, 7.0 * way), fallen_at(0, 0)[1])) == expected
    assert not strays(np.zeros((1, 2)), math.inf)(0, fallen_at(1e9, 1e9))


def test_what_goes_far_does_so_from_where_it_began_itself_and_in_any_direction():
    leaves = strays(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]]), 0.01)
    turned = fallen_at(0, 0)[1]
    for number, middle in enumerate(([0.0, 0.0, 0.0], [1.0, 0.0, 0.5])):
        for axis in range(3):
            for far, expected in ((0.0099, False), (0.0101, True)):
                at = list(middle)
                at[axis] += far
                assert leaves(number, (tuple(at), turned)) == expected


def test_what_is_gone_is_below_everything_that_it_could_land_on():
    gone = falls_below(-0.1)
    assert [gone(0, ((5.0, 5.0, z), fallen_at(0, 0)[1])) for z in (0.0, -0.0999, -0.1001, -9.0)] == [
        False,
        False,
        True,
        True,
    ]


def record_of(*steps) -> float:
    """The rise over (height, velocity) in turn."""
    record = EnergyRecord([BODY], [((0.0, 0.0, steps[0][0]), UPRIGHT)], [steps[0][1]])
    for height, moving in steps[1:]:
        record.add([((0.0, 0.0, height), UPRIGHT)], [moving])
    return record.rise()


def test_a_free_fall_keeps_its_energy():
    fall = [(1.0 - d, ((0.0, 0.0, -math.sqrt(2 * GRAVITY_M_S2 * d)), (0.0, 0.0, 0.0))) for d in (0.0, 0.1, 0.5, 0.9)]
    assert record_of(*fall) == pytest.approx(0.0, abs=1e-9)


def test_a_rise_is_measured_from_the_least_so_far_and_against_all_that_was_set_free():
    heights = [1.0, 0.4, 0.4004, 0.3, 0.3003, 0.0]
    assert record_of(*((height, AT_REST) for height in heights)) == pytest.approx(4e-4 / (SHARE * 1.0))


def test_where_little_is_set_free_the_bound_is_a_height():
    assert record_of((0.1, AT_REST), (0.1 + 3 * LIFT_M, AT_REST)) == pytest.approx(3.0)


@pytest.mark.parametrize("seed", range(4))
def test_turning_counts_by_the_moments_along_the_bodys_axes_whatever_its_pose(seed):
    rng = np.random.default_rng(seed)
    R, spin = uniform_rotation(rng), rng.standard_normal(3)
    at = ((0.3, -0.2, 0.0), tuple(quaternion_from_rotation(R)))
    record = EnergyRecord([BODY], [at], [AT_REST])
    record.add([at], [((0.0, 0.0, 0.0), tuple(spin))])
    joules = spin @ (R @ np.diag(BODY.moments) @ R.T) @ spin / 2
    assert record.rise() * LIFT_M * BODY.mass_kg * GRAVITY_M_S2 == pytest.approx(joules, rel=1e-12)


def test_what_one_of_two_gains_of_the_other_is_no_rise():
    light = Body(1.0, BODY.moments, BODY.parts)
    high, low = ((0.0, 0.0, 1.0), UPRIGHT), ((0.0, 0.0, 0.0), UPRIGHT)
    record = EnergyRecord([BODY, light], [high, low], [AT_REST, AT_REST])
    record.add([low, ((0.0, 0.0, 2.0), UPRIGHT)], [AT_REST, AT_REST])
    assert record.rise() == pytest.approx(0.0)
