"""A ball that bounces: the restitution of a contact is the product of both bodies', here of one with itself."""

import numpy as np
import pytest

from tests.hard_cases.drops import Y, turn
from tests.physics.room import at, ball_body, box_body, drop, physics
from workers.geometry.frames import pose

RADIUS_M = 0.05
RATES_HZ = (480, 960, 3840, 15_360)


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
    record_figure(f"bounce from {height_m * 1e3:g} mm: error of the height's share", "passed", worst, 0.01)
    assert worst < 0.01


@pytest.mark.parametrize("degrees", [1.0, 10.0, 30.0, 44.0])
@pytest.mark.parametrize("rate_hz", [960, 15_360])
def test_a_box_bounces_off_its_edge_as_an_impulse_there_makes_it(degrees, rate_hz):
    """Without friction J = m (1 + e) v / (1 + m x^2 / I), x ahead of the centre of mass (Goldsmith 1960, 2.1)."""
    body, R, e = box_body(0.1, 0.1, 0.1), turn(Y, degrees), 0.9**2
    corners = body.parts[0] @ R.T
    x, low = corners[corners[:, 2].argmin(), 0], corners[:, 2].min()
    settings = physics(step_hz=rate_hz, restitution=0.9, friction=0.0)
    with drop(body, pose(R, np.array([0.0, 0.0, 0.05 - low])), 0.0, settings, 1) as world:
        fell = 0.0
        while world.velocity()[1][1] == 0.0:
            fell = -world.velocity()[0][2]
            world.advance()
        v, w = world.velocity()
    share = (1.0 + e) / (1.0 + body.mass_kg * x * x / body.moments[1])
    assert v[2] == pytest.approx(fell * (share - 1.0), abs=0.03 * fell)
    assert w[1] == pytest.approx(-x * fell * share * body.mass_kg / body.moments[1], rel=0.03)
