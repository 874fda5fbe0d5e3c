"""A body that spins freely, against Euler's equations: gyroscopic torque."""

import functools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from schemas.base import Array
from tests.kit.gravity import set_gravity
from tests.physics.room import advance, at, box_body, drop, order, physics
from workers.geometry.frames import rotation_from_quaternion

BOX = box_body(0.02, 0.06, 0.1)
"""Its intermediate axis is y."""

RATES_HZ = (960, 1920, 3840, 7680)
SPIN_RAD_S = 12.0
WATCHED_S = 1.0
PUSHED = np.array([0.01, 1.0, 0.01]) * SPIN_RAD_S
"""About the intermediate axis, but for a hundredth."""


@functools.cache
def simulated(rate_hz: int, seconds: float, spin: tuple[float, ...]) -> tuple[Array, Array]:
    """(R_world_body [3, 3], angular velocity [3] in the world), in the air without gravity."""
    with drop(BOX, at(0.0, 3.0), 0.0, physics(step_hz=rate_hz), 1) as world:
        set_gravity(world, (0.0, 0.0, 0.0))
        world.set_velocity((0.0, 0.0, 0.0), spin)
        advance(world, round(rate_hz * seconds))
        return rotation_from_quaternion(np.array(world.pose()[1])), np.array(world.velocity()[1])


@functools.cache
def exact(seconds: float, spin: tuple[float, ...]) -> tuple[Array, Array]:
    """The same by Runge-Kutta: I w' = (I w) x w in the body's axes, whose rotation turns by w (Goldstein 2002, 5.5)."""
    moments = BOX.moments

    def rates(_: float, state: Array) -> Array:
        R, w = state[:9].reshape(3, 3), state[9:]
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(R @ cross).ravel(), np.cross(moments * w, w) / moments])

    begun = np.concatenate([np.eye(3).ravel(), spin])
    end = solve_ivp(rates, (0.0, seconds), begun, rtol=1e-11, atol=1e-12, method="DOP853").y[:, -1]
    R = end[:9].reshape(3, 3)
    return R, R @ end[9:]


def angle_deg(a: Array, b: Array) -> float:
    return math.degrees(2.0 * math.asin(min(1.0, float(np.linalg.norm(a - b)) / math.sqrt(8.0))))


def kinetic(R: Array, w: Array) -> float:
    return float(BOX.moments @ (R.T @ w) ** 2) / 2


def test_a_body_spun_about_its_intermediate_axis_flips_as_eulers_equations_have_it(record_figure):
    """Bullet takes the gyroscopic torque at a step's beginning, and so is of the first order."""
    R, _ = exact(WATCHED_S, tuple(PUSHED))
    errors = [angle_deg(simulated(rate, WATCHED_S, tuple(PUSHED))[0], R) for rate in RATES_HZ]
    record_figure("spin about the intermediate axis: error after a flip at 960 Hz, degrees", "passed", errors[0], 2.0)
    record_figure("spin about the intermediate axis: order in the step", "passed", order(RATES_HZ, errors), 1.0)
    assert R[1, 1] < -0.9  # its y axis has turned over, or nothing is shown
    assert order(RATES_HZ, errors) == pytest.approx(1.0, abs=0.05)
    assert errors[0] < 2.0


def test_a_body_that_spins_freely_keeps_its_energy_but_for_what_a_step_adds(record_figure):
    """Explicit steps add energy; production's are shorter by as much as things spin faster, up to 16 times."""
    begun = kinetic(np.eye(3), PUSHED)
    rises = [kinetic(*simulated(rate, WATCHED_S, tuple(PUSHED))) / begun - 1.0 for rate in RATES_HZ]
    record_figure("free spin: share of its energy that a flip adds at 960 Hz", "passed", rises[0], 0.02)
    record_figure("free spin: order of what a flip adds in the step", "passed", order(RATES_HZ, rises), 1.0)
    assert rises[0] < 0.02
    assert order(RATES_HZ, rises) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("axis", range(3))
def test_a_body_spun_about_a_principal_axis_goes_on_spinning_about_it(axis, record_figure):
    spin = 200.0 * np.eye(3)[axis]
    R, w = simulated(15360, 0.25, tuple(spin))
    turned = math.remainder(200.0 * 0.25, 2.0 * math.pi)
    error = max(float(np.abs(w - spin).max()) / 200.0, abs(angle_deg(R, np.eye(3)) - math.degrees(abs(turned))) / 360.0)
    record_figure(f"spin about principal axis {axis} at 200 rad/s: relative error", "passed", error, 1e-6)
    assert error < 1e-6
