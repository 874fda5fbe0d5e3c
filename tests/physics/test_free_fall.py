"""A body in the air, against half g t squared."""

import pytest

from tests.physics.room import RATES_HZ, G, advance, at, box_body, drop, order, physics

FALL_S = 0.5
HEIGHT_M = 3.0


def fallen(rate_hz: int) -> float:
    """Metres that a body falls in `FALL_S`."""
    with drop(box_body(0.1, 0.08, 0.2), at(0, HEIGHT_M), 0.0, physics(step_hz=rate_hz), 1) as world:
        advance(world, round(FALL_S * rate_hz))
        return HEIGHT_M - world.pose()[0][2]


def test_free_fall_is_off_by_half_a_step_at_the_final_speed_and_by_nothing_else(record_figure):
    """Semi-implicit Euler: z_n = -g h^2 n (n + 1) / 2, so it is g t h / 2 ahead (Hairer, Lubich, Wanner 2006, I.1)."""
    errors = [fallen(rate) - G * FALL_S**2 / 2 for rate in RATES_HZ]
    rest = max(abs(error - G * FALL_S / rate / 2) for rate, error in zip(RATES_HZ, errors, strict=True))
    record_figure("free fall: error at 960 Hz, mm", "passed", errors[2] * 1e3)
    record_figure("free fall: error beyond g t h / 2, m", "passed", rest, 1e-9)
    record_figure("free fall: order in the step", "passed", order(RATES_HZ, errors), 1.0)
    assert rest < 1e-9
    assert order(RATES_HZ, errors) == pytest.approx(1.0, abs=1e-6)
