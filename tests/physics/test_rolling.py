"""A ball that rolls on level ground and on another body, against the torque of rolling friction."""

import pytest

from tests.physics.room import MARGIN_M, PHYSICS, RATES_HZ, G, advance, at, ball_body, box_body, drop, physics
from workers.physics.bullet import open_world

RADIUS_M = 0.05
ARM_M = 2 * PHYSICS.rolling_friction * PHYSICS.friction_of("table")
"""Bullet's lever arm, metres: over both bodies, rolling friction times the other's friction."""


def speeds(rate_hz: int, seconds: float, first_m_s: float, spin_rad_s: float, **changes) -> tuple[float, float]:
    """Speed, m/s, and spin, rad/s, about the axis across, after so long on the ground."""
    settings = physics(step_hz=rate_hz, **changes)
    with drop(ball_body(RADIUS_M), at(0, RADIUS_M), 0.0, settings, 1) as world:
        advance(world, rate_hz // 4)
        world.set_velocity((first_m_s, 0, 0), (0, spin_rad_s, 0))
        advance(world, round(rate_hz * seconds))
        v, w = world.velocity()
        return v[0], w[1]


def test_a_rolling_ball_slows_down_by_its_rolling_friction(record_figure):
    """a = arm g / (R (1 + 2 / 5)): no error in the step at all, because the torque is constant."""
    exact = 1.0 - 2.0 * ARM_M * G / (RADIUS_M * 1.4)
    errors = [speeds(rate, 2.0, 1.0, 1.0 / RADIUS_M)[0] - exact for rate in RATES_HZ]
    record_figure("rolling: error of the speed after 2 s, m/s", "passed", max(map(abs, errors)), 1e-9)
    assert max(map(abs, errors)) < 1e-9


def test_a_ball_rolls_and_spins_on_another_body_against_the_torque_that_it_has_on_the_ground(record_figure):
    """The same speed on top of a box of a tonne; and about the vertical arm g / (2 / 5 R^2), on a point."""
    spin, below = RADIUS_M**-1, (box_body(10.0, 1.0, 0.2, 1e3), at(0, 0.1 + MARGIN_M))
    with open_world([below, (ball_body(RADIUS_M), at(0, 0.2 + 2 * MARGIN_M + RADIUS_M))], 0.0, PHYSICS, 1) as world:
        advance(world, PHYSICS.step_hz // 4)
        world.set_velocity((1.0, 0.0, 0.0), (0.0, spin, spin), body=1)
        advance(world, 2 * PHYSICS.step_hz)
        v, w = world.velocity(1)
    rolls = v[0] - (1.0 - 2.0 * ARM_M * G / (RADIUS_M * 1.4))
    spins = w[2] - (spin - 2.0 * 2 * PHYSICS.spinning_friction * PHYSICS.friction_of("table") * G / (0.4 * RADIUS_M**2))
    record_figure("rolling on a body: error of the speed after 2 s, m/s", "passed", rolls, 1e-8)
    record_figure("spinning on a body: error of the spin after 2 s, rad/s", "passed", spins, 1e-6)
    assert abs(rolls) < 1e-8 and abs(spins) < 1e-6


def test_a_ball_without_rolling_friction_rolls_for_ever(record_figure):
    error = speeds(960, 4.0, 1.0, 1.0 / RADIUS_M, rolling_friction=0.0)[0] - 1.0
    record_figure("rolling without friction: error of the speed after 4 s, m/s", "passed", error, 1e-9)
    assert abs(error) < 1e-9


def test_a_ball_that_is_pushed_without_spin_slides_until_it_rolls_at_five_sevenths(record_figure):
    v, w = speeds(960, 1.0, 1.0, 0.0, rolling_friction=0.0)
    record_figure("from sliding to rolling: error of the speed, m/s", "passed", v - 5 / 7, 1e-9)
    assert v == pytest.approx(5 / 7, abs=1e-9)  # angular momentum about the contact stays, whatever the step
    assert w * RADIUS_M == pytest.approx(v, abs=1e-9)
