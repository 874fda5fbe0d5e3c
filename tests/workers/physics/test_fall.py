"""The size of steps, the fall that is not simulated, and what ends a simulation."""

import math

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import ObjectStart
from schemas.scene.shape import Mesh
from tests.kit.shapes import asset_of, box
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
from workers.physics.fall import FINEST, SKIPPED_TO_M, StepSizes, fall
from workers.physics.rigid_body import Body, as_pose, make_body

PHYSICS = Job(name="t").physics
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


def test_without_a_bound_on_their_travel_steps_stay_as_long_as_they_are():
    assert COARSE.rate_hz(1e9) == PHYSICS.step_hz


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


def test_a_pose_comes_back_from_its_quaternion():
    T = pose(uniform_rotation(np.random.default_rng(2)), np.array([0.1, 0.2, 0.3]))
    quaternion = quaternion_from_rotation(T[:3, :3])
    assert as_pose(((0.1, 0.2, 0.3), tuple(quaternion))) == pytest.approx(T, abs=1e-12)


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
