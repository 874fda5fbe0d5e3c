"""Sliding, against Coulomb. The friction of a contact is the product of both bodies', here of one with itself."""

import math

import pytest

from tests.kit.gravity import set_gravity
from tests.physics.room import MARGIN_M, PHYSICS, G, advance, at, box_body, drop, order, physics, slope

MU = PHYSICS.friction**2
CRITICAL_RAD = math.atan(MU)
RATES_HZ = (480, 960, 1920, 3840)
FLAT = box_body(0.2, 0.2, 0.01)
"""So low that it neither leans nor tips."""


def slid(rate_hz: int, speed_m_s: float) -> float:
    """Metres that the box slides on level ground when it is pushed, after it has come to rest."""
    settings = physics(step_hz=rate_hz)
    with drop(FLAT, at(0, 0.005 + MARGIN_M), 0.0, settings, 1) as world:
        advance(world, rate_hz)
        before = world.pose()[0][0]
        world.set_velocity((speed_m_s, 0.0, 0.0))
        advance(world, rate_hz)
        return world.pose()[0][0] - before


def speed_on_slope(rate_hz: int, angle_rad: float, heading_rad: float) -> float:
    """Speed, m/s, that the box has half a second after the level ground under it became a slope."""
    settings = physics(step_hz=rate_hz)
    with drop(FLAT, at(0, 0.005 + MARGIN_M), 0.0, settings, 1) as world:
        advance(world, rate_hz)
        set_gravity(world, slope(angle_rad, heading_rad))
        advance(world, rate_hz // 2)
        return math.hypot(*world.velocity()[0][:2])


def test_a_box_slides_as_far_as_its_friction_lets_it(record_figure):
    """v^2 / (2 mu g), less half a step at the first speed: semi-implicit Euler brakes before it moves.

    Beyond that two thousandths of the way at 960 Hz, where corners of the box lose the ground for single steps.
    """
    exact = 1.0 / (2 * MU * G)
    errors = [slid(rate, 1.0) - exact for rate in RATES_HZ[1:]]
    beyond = [abs(error + 0.5 / rate) for rate, error in zip(RATES_HZ[1:], errors, strict=True)]
    record_figure("sliding distance: error at 960 Hz, mm", "passed", errors[0] * 1e3, -0.5e3 / 960)
    record_figure("sliding distance: beyond half a step at 960 Hz, share", "passed", beyond[0] / exact, 2e-3)
    for rate, found in zip(RATES_HZ[1:], beyond, strict=True):
        assert found < 2e-3 * exact * (960 / rate)


@pytest.mark.parametrize("heading_deg", [0.0, 45.0, 57.3])
def test_a_slope_accelerates_a_box_by_what_friction_leaves_of_gravity(heading_deg, record_figure):
    """a = g (sin - mu cos), so that a speed tells the friction, in every direction: a cone, not a pyramid."""
    angle = math.radians(35.0)
    found = [
        math.tan(angle) - speed_on_slope(rate, angle, math.radians(heading_deg)) / (G * 0.5 * math.cos(angle))
        for rate in RATES_HZ
    ]
    errors = [math.degrees(math.atan(mu) - CRITICAL_RAD) for mu in found]
    name = f"critical angle towards {heading_deg:g} degrees"
    record_figure(f"{name}: error at 960 Hz, degrees", "passed", errors[1], 0.25)
    # A pyramid would be off by up to ten degrees. Off the axes the contacts' friction acts along directions of one step ago.
    assert max(map(abs, errors)) < 0.25
    if heading_deg == 0.0:
        record_figure(f"{name}: order in the step", "passed", order(RATES_HZ, errors), 1.0)
        assert order(RATES_HZ, errors) > 0.9


@pytest.mark.parametrize("heading_deg", [0.0, 30.0])
def test_a_box_stands_just_below_the_critical_angle_and_slides_just_above(heading_deg, record_figure):
    heading, near = math.radians(heading_deg), math.radians(0.2)
    below, above = (speed_on_slope(960, CRITICAL_RAD + sign * near, heading) for sign in (-1, 1))
    record_figure(f"critical angle {heading_deg:g}: speed 0.2 degrees below, mm/s", "passed", below * 1e3, 1.0)
    assert below < 1e-3
    assert above == pytest.approx(G * math.sin(near) / math.cos(CRITICAL_RAD) * 0.5, rel=0.4)
