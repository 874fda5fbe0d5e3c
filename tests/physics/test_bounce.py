"""A ball that bounces: the restitution of a contact is the product of both bodies', here of one with itself."""

import pytest

from tests.physics.room import at, ball_body, drop, physics

RADIUS_M = 0.05
RATES_HZ = (480, 960, 1920, 3840)


def rebound(rate_hz: int, height_m: float, restitution: float) -> float:
    """How high a ball comes that falls from this height, over the height."""
    settings = physics(step_hz=rate_hz, restitution=restitution)
    top, rising = 0.0, False
    with drop(ball_body(RADIUS_M), at(0, RADIUS_M + height_m), 0.0, settings, 1) as world:
        for _ in range(2 * rate_hz):
            world.advance()
            speed = world.velocity()[0][2]
            if rising and speed < 0:
                break
            rising = rising or speed > 0
            top = max(top, world.pose()[0][2] - RADIUS_M) if rising else 0.0
    return top / height_m


def test_a_ball_without_restitution_stays_where_it_falls(record_figure):
    worst = max(rebound(rate, 0.3, 0.0) for rate in RATES_HZ)
    record_figure("bounce without restitution: share of the height", "passed", worst, 1e-3)
    assert worst < 1e-3


@pytest.mark.parametrize("height_m", [0.05, 0.3])
def test_a_ball_bounces_to_the_square_of_the_contacts_restitution(height_m, record_figure):
    shares = [rebound(rate, height_m, 0.9) for rate in RATES_HZ]
    worst = max(abs(share - 0.9**4) for share in shares)
    record_figure(f"bounce from {height_m * 1e3:g} mm: error of the height's share", "passed", worst, 0.05)
    assert worst < 0.05
