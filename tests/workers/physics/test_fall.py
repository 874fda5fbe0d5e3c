"""The energy of a falling body, against closed forms; what ends its fall early: what leaves, and what stands.

The size of steps, the fall that is not simulated, and what ends a simulation.
"""

import dataclasses
import math

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ObjectStart
from tests.kit.shapes import asset_of, box, table
from workers.geometry.frames import (
    pose,
    quaternion_from_rotation,
    translation,
)
from workers.geometry.hull import convex_hull
from workers.physics.bullet import GRAVITY_M_S2
from workers.physics.fall import (
    FINEST,
    LIFT_M,
    SHARE,
    SKIPPED_TO_M,
    SLIDE_M,
    EnergyRecord,
    StepSizes,
    fall,
    stays_standing,
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


@pytest.mark.parametrize("friction", [0.1, 0.49])
def test_what_would_slide_further_than_the_bound_does_not_count_as_standing(friction):
    """Friction brakes by mu g: the way is v^2 / (2 mu g)."""
    speed = math.sqrt(2.0 * friction * GRAVITY_M_S2 * SLIDE_M)
    box_ = start_of(0.1, 0.08, 0.2)
    assert stands(box_, v=(0.99 * speed, 0.0, 0.0), friction=friction)
    assert not stands(box_, v=(1.01 * speed, 0.0, 0.0), friction=friction)
    assert not stands(box_, v=(1e-6, 0.0, 0.0), friction=0.0)


@pytest.mark.parametrize("width", [0.01, 0.02])
def test_what_has_the_energy_to_tip_over_its_nearest_edge_does_not_count_as_standing(width):
    """The centre of mass rises from h to the root of h^2 and the half width squared."""
    height = 0.1
    barrier_m = math.hypot(height, width) / 2.0 - height / 2.0
    assert stands(start_of(width, 0.05, height, up_m=0.99 * (barrier_m - LIFT_M)))
    assert not stands(start_of(width, 0.05, height, up_m=1.01 * (barrier_m - LIFT_M)))


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


def record_of(*steps) -> float:
    """The rise over (height, velocity) in turn."""
    record = EnergyRecord([BODY], [((0.0, 0.0, steps[0][0]), UPRIGHT)], [steps[0][1]])
    for height, moving in steps[1:]:
        record.add([((0.0, 0.0, height), UPRIGHT)], [moving])
    return record.rise()


def test_a_rise_is_measured_from_the_least_so_far_and_against_all_that_was_set_free():
    heights = [1.0, 0.4, 0.4004, 0.3, 0.3003, 0.0]
    assert record_of(*((height, AT_REST) for height in heights)) == pytest.approx(4e-4 / (SHARE * 1.0))


COARSE = StepSizes(PHYSICS.step_hz, math.inf)


BOX = asset_of(box(0.1, 0.08, 0.2))


def start_at(T) -> ObjectStart:
    return ObjectStart(BOX, convex_hull(BOX.shape.vertices), 3, T, 0, False)


def for_seconds(seconds: float) -> Physics:
    return PHYSICS.model_copy(update={"max_settle_s": seconds})


@pytest.mark.parametrize(
    ("speed_m_s", "times"), [(0.0, 1), (0.0959, 1), (0.0961, 2), (0.19, 2), (0.2, 4), (0.7, 8), (1.0, 16), (500.0, 16)]
)
def test_steps_are_shorter_by_powers_of_two_until_none_goes_too_far_and_never_more_than_sixteen(speed_m_s, times):
    """0.1 mm a step at 960 Hz is 0.096 m/s."""
    assert StepSizes(960.0, 1e-4).rate_hz(speed_m_s) == 960.0 * times
    assert FINEST == 16


@pytest.mark.parametrize("free_m", [0.0, 0.05, 0.3])
def test_the_part_of_a_fall_that_is_not_simulated_is_exact_and_the_rest_half_a_step_ahead(free_m):
    """Semi-implicit Euler is g t h / 2 ahead after the time t (Hairer, Lubich, Wanner 2006, I.1)."""
    start = start_at(translation(0.0, 0.0, 2.0))
    body = make_body(start)
    motion = fall([body], [start.T_world_obj], 0.0, for_seconds(0.4), COARSE, free_m)
    skipped_s = math.sqrt(2.0 * max(0.0, free_m - SKIPPED_TO_M) / GRAVITY_M_S2)
    ahead = GRAVITY_M_S2 * (motion.seconds - skipped_s) / PHYSICS.step_hz / 2
    fallen = 2.0 - motion.poses[0][2, 3]
    assert fallen == pytest.approx(GRAVITY_M_S2 * motion.seconds**2 / 2 + ahead, abs=1e-9)
    assert 0.4 <= motion.seconds <= 0.4 + 8.0 / PHYSICS.step_hz
    assert motion.poses[0][:3, :3] == pytest.approx(np.eye(3), abs=1e-12)


@pytest.mark.parametrize("height_m", [0.03, 0.3])
def test_what_falls_freely_lands_when_half_g_t_squared_says(height_m):
    start = start_at(translation(0.0, 0.0, 0.1 + height_m))
    motion = fall([make_body(start)], [start.T_world_obj], 0.0, for_seconds(8.0), COARSE, height_m)
    landed = math.sqrt(2.0 * height_m / GRAVITY_M_S2)
    window, looks = PHYSICS.rest.window_s, 4 * 8 / PHYSICS.step_hz
    assert motion.rested
    assert landed + window <= motion.seconds <= landed + window + looks
    assert motion.poses[0][2, 3] == pytest.approx(0.1, abs=2e-5)


def test_a_stop_condition_ends_the_fall_and_is_named():
    start = start_at(translation(0.0, 0.0, 1.0))
    body = make_body(start)
    stops = {"never": lambda _, at: False, "below": lambda _, at: at[0][2] < 0.9}
    motion = fall([body], [start.T_world_obj], 0.0, for_seconds(8.0), COARSE, 0.0, stops)
    assert (motion.stopped_by, motion.rested) == ("below", False)
    assert 0.9 - 8 * 2.0 / PHYSICS.step_hz <= motion.poses[0][2, 3] < 0.9
    after = motion.speed_m_s - math.sqrt(2 * GRAVITY_M_S2 * 0.1)
    assert 0.0 <= after <= 9 * GRAVITY_M_S2 / PHYSICS.step_hz  # it looks every eight steps
