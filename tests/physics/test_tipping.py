"""A box over one of its edges: the slope on which it tips, and how it rocks."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from schemas.job.physics import Physics
from tests.kit.gravity import set_gravity
from tests.physics.room import G, advance, at, box_body, drop, lean, order, physics, slope
from workers.physics.rigid_body import MARGIN_M

WIDTH_M, HEIGHT_M = 0.06, 0.2
BOX = dataclasses.replace(box_body(WIDTH_M, 0.1, HEIGHT_M), margin_m=MARGIN_M)
SHARP_M = 1e-6
SHARP = dataclasses.replace(BOX, margin_m=SHARP_M)
TIPPING_RAD = math.atan(WIDTH_M / HEIGHT_M)
ARM_M = math.hypot(WIDTH_M, HEIGHT_M) / 2
RATE2 = G * ARM_M / ((WIDTH_M**2 + HEIGHT_M**2) / 12 + ARM_M**2)
"""m g R / I about the edge, 1/s^2: the square of Housner's p (1963, Bulletin of the Seismological Society of America 53)."""

RATES_HZ = (480, 960, 1920, 3840)
TIPPED_RAD = 0.1


def hard(rate_hz: int, rolling_friction: float = 0.0) -> Physics:
    """Friction that holds the edge where it is, sharp edges, and no torque against rolling over them."""
    return physics(step_hz=rate_hz, friction=1.0, rolling_friction=rolling_friction, spinning_friction=0.0)


def tips(settings: Physics, nearly_rad: float, angle_rad: float) -> bool:
    """Whether the box leans away within two seconds after the ground's slope grew from one angle to another.

    From level ground at once, the jolt alone would tip it a few tenths of a degree too early.
    """
    with drop(BOX, at(0, HEIGHT_M / 2 + MARGIN_M), 0.0, settings, 1) as world:
        advance(world, settings.step_hz // 4)
        set_gravity(world, slope(nearly_rad))
        advance(world, settings.step_hz // 2)
        set_gravity(world, slope(angle_rad))
        for _ in range(2 * settings.step_hz):
            world.advance()
            if abs(lean(world)) > TIPPED_RAD:
                return True
    return False


def tipping_angle(settings: Physics, about_rad: float = TIPPING_RAD) -> float:
    """By bisection, to 0.001 degrees; radians."""
    low, high = about_rad - 0.006, about_rad + 0.03
    while high - low > 2e-5:
        middle = (low + high) / 2
        low, high = (low, middle) if tips(settings, 0.97 * about_rad, middle) else (middle, high)
    return (low + high) / 2


def first_quarter(settings: Physics, lean_rad: float) -> float:
    """Seconds from rest on one edge, leaning by `lean_rad`, to upright; between steps by a straight line."""
    x, z = WIDTH_M / 2, HEIGHT_M / 2
    c, s = math.cos(lean_rad), math.sin(lean_rad)
    over = at(z * s - x * c, z * c + x * s + SHARP_M, lean_rad)  # the edge at +x lies on the y axis
    before = lean_rad
    with drop(SHARP, over, 0.0, settings, 1) as world:
        for step in range(settings.step_hz):
            world.advance()
            now = lean(world)
            if now <= 0.0:
                return (step + before / (before - now)) / settings.step_hz
            before = now
    return math.nan


def exact_quarter(lean_rad: float) -> float:
    """The same from Housner's equation before he makes it linear, lean'' = -p^2 sin(alpha - lean), by Runge-Kutta."""

    def upright(t: float, state: np.ndarray) -> float:
        return state[0]

    path = solve_ivp(
        lambda t, state: [state[1], -RATE2 * math.sin(TIPPING_RAD - state[0])],
        (0.0, 5.0),
        [lean_rad, 0.0],
        rtol=1e-11,
        atol=1e-13,
        events=upright,
    )
    return float(path.t_events[0][0])


def test_a_box_tips_where_its_centre_passes_its_edge(record_figure):
    """What is left of the jolt is some steps of gravity, of either sign: a bound that shrinks with the step, no line."""
    errors = [math.degrees(tipping_angle(hard(rate)) - TIPPING_RAD) for rate in RATES_HZ]
    for rate, error in zip(RATES_HZ, errors, strict=True):
        record_figure(f"tipping angle: error at {rate} Hz, degrees", "passed", error, 48.0 / rate)
    assert [rate for rate, error in zip(RATES_HZ, errors, strict=True) if abs(error) > 48.0 / rate] == []


def test_rolling_friction_holds_a_box_over_its_edge_by_no_more_than_its_lever_arm(record_figure):
    """Bullet's arm is the sum over both bodies of rolling friction times the other's friction, here twice 0.5 mm.

    Its solver gives a fifth more over an edge, whose two contacts share the weight from step to step, and all of it at 15 kHz.
    """
    arm = math.degrees(math.atan((WIDTH_M / 2 + 1e-3) / (HEIGHT_M / 2)) - TIPPING_RAD)
    held = math.degrees(tipping_angle(hard(960, rolling_friction=5e-4)) - TIPPING_RAD)
    record_figure("tipping angle: degrees that rolling friction adds at 960 Hz", "passed", held, arm)
    assert 0.05 < held < 1.25 * arm


@pytest.mark.parametrize("share", [0.25, 0.5, 0.8])
def test_a_tilted_box_falls_back_in_housners_time(share, record_figure):
    """Semi-implicit Euler from rest is half a step ahead."""
    exact = exact_quarter(share * TIPPING_RAD)
    errors = [first_quarter(hard(rate), share * TIPPING_RAD) - exact for rate in RATES_HZ]
    name = f"rocking from {share:g} of the tipping angle"
    record_figure(f"{name}: error of the quarter period at 960 Hz, ms", "passed", errors[1] * 1e3, -0.5e3 / 960)
    record_figure(f"{name}: order in the step", "passed", order(RATES_HZ, errors), 1.0)
    assert errors == pytest.approx([-0.5 / rate for rate in RATES_HZ], rel=0.2)
    assert order(RATES_HZ, errors) == pytest.approx(1.0, abs=0.1)
