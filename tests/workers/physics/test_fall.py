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
from schemas.scene.shape import Mesh
from tests.kit.shapes import asset_of, box, table
from workers.geometry.frames import (
    pose,
    quaternion_from_rotation,
    rotation_about,
    transform,
    translation,
    uniform_rotation,
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


@pytest.mark.parametrize("seed", range(4))
def test_turning_counts_by_the_moments_along_the_bodys_axes_whatever_its_pose(seed):
    rng = np.random.default_rng(seed)
    R, spin = uniform_rotation(rng), rng.standard_normal(3)
    at = ((0.3, -0.2, 0.0), tuple(quaternion_from_rotation(R)))
    record = EnergyRecord([BODY], [at], [AT_REST])
    record.add([at], [((0.0, 0.0, 0.0), tuple(spin))])
    joules = spin @ (R @ np.diag(BODY.moments) @ R.T) @ spin / 2
    assert record.rise() * LIFT_M * BODY.mass_kg * GRAVITY_M_S2 == pytest.approx(joules, rel=1e-12)


Z = np.array([0.0, 0.0, 1.0])
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


def bevelled(heading: int) -> Mesh:
    """Level up to x = 0, from there down by 22 degrees and by 63, turned about z by so many quarters."""
    x, z = np.array([-0.5, 0.0, 0.004, 0.006]), np.array([0.0, 0.0, -0.0016, -0.0055])
    vertices = np.stack([np.repeat(x, 2), np.tile([-0.5, 0.5], 4), np.repeat(z, 2)], axis=1)
    faces = np.concatenate([2 * k + np.array([[0, 2, 3], [0, 3, 1]]) for k in range(3)])
    return Mesh(transform(pose(rotation_about(Z, heading * math.pi / 2), np.zeros(3)), vertices), faces)


@pytest.mark.parametrize("inside_m", [0.0005, 0.001, 0.0015, 0.002])
@pytest.mark.parametrize("heading", range(4))
def test_a_corner_that_comes_down_beside_an_edge_of_a_mesh_does_not_sink_in(heading, inside_m):
    """A hundredth of a millimetre is what Bullet leaves: the steps that foresee a contact end at it."""
    corners = 0.08 * np.concatenate([np.eye(3), -np.eye(3)])
    body = Body(0.3, np.full(3, 4e-4), (corners,), 1e-4, reach_m=0.08)
    start = rotation_about(Z, heading * math.pi / 2) @ np.array([-inside_m, 0.013, 0.0801 + 0.005])
    steps = StepSizes(PHYSICS.step_hz, PHYSICS.max_step_travel_mm / 1e3)
    end = fall([body], [translation(*start)], bevelled(heading), for_seconds(0.04), steps, 0.005)
    lowest = transform(end.poses[0], corners)[:, 2].min() - 1e-4
    assert end.seconds > 0.035
    assert -1.3e-5 < lowest < 1e-5


def test_a_domino_that_sleeps_is_knocked_over_as_one_that_is_awake():
    domino = asset_of(box(0.01, 0.08, 0.2))
    standing = ObjectStart(domino, convex_hull(domino.shape.vertices), 3, translation(0.0, 0.0, 0.1 + 2e-5), 0, False)
    falling = start_at(pose(rotation_about(np.array([0.0, 1.0, 0.0]), 0.5), np.array([0.05, 0.0, 2.0])))
    poses = [start.T_world_obj for start in (standing, falling)]
    bodies = [make_body(start) for start in (standing, falling)]
    awake, asleep = (
        fall(bodies, poses, 0.0, for_seconds(5.0), StepSizes(960.0, 1e-3), 0.0, sleeping=sleeping)
        for sleeping in (False, True)
    )
    assert awake.rested and asleep.rested
    assert abs(awake.poses[0][2, 2]) < 1e-6  # flat
    assert asleep.poses[0] == pytest.approx(awake.poses[0], abs=1e-3)
