"""Every hard case in the air and on a tip: what is conserved, and where it is when."""

import math

import numpy as np
import pytest

from tests.hard_cases.flight_cases import (
    FLIGHTS,
    RISES,
    energies,
    exact,
    exact_top,
    flips,
    flown,
    lean_of_top,
    momenta,
    sleeping_rad_s,
    turned_otherwise_deg,
)

ROWS = [pytest.param(one, id=one.name) for one in FLIGHTS]


@pytest.mark.parametrize("flight", ROWS)
def test_what_flies_keeps_its_momentum_and_energy_and_turns_as_euler_has_it(flight, record_figure):
    R, w = flown(flight)
    wanted, _ = exact(flight)
    momentum, energy = momenta(flight, R, w), energies(flight, R, w)
    drift = float(np.linalg.norm(momentum - momentum[0], axis=1).max() / np.linalg.norm(momentum[0]))
    rises, falls = float(energy.max() / energy[0] - 1.0), float(1.0 - energy.min() / energy[0])
    off = turned_otherwise_deg(R, wanted)
    record_figure(f"{flight.name}: change of its angular momentum", "must hold", drift, flight.kept)
    record_figure(f"{flight.name}: rise of its energy", "must hold", rises, RISES)
    record_figure(f"{flight.name}: fall of its energy", "must hold", falls, flight.kept)
    record_figure(f"{flight.name}: turned otherwise at the end, deg", "must hold", off, flight.degrees)
    assert drift <= flight.kept and rises <= RISES and falls <= flight.kept and off <= flight.degrees


def test_a_box_flips_as_often_and_when_eulers_equations_have_it(record_figure):
    flight = FLIGHTS[0]
    ours, wanted = flips(flown(flight)[0], 1), flips(exact(flight)[0], 1)
    assert len(wanted) >= 4  # or nothing is shown
    assert len(ours) == len(wanted)
    period, exact_period = np.diff(ours).mean(), np.diff(wanted).mean()
    record_figure("box flips about its middle axis: period off", "must hold", abs(period / exact_period - 1.0), 0.01)
    assert period == pytest.approx(exact_period, rel=0.01)


def test_a_fast_top_sleeps_and_precesses_as_lagrange_has_it(record_figure):
    fast, lean = 1.8 * sleeping_rad_s(), math.radians(5.0)
    (most, turned), (wanted_most, wanted) = lean_of_top(fast, lean, 1.5), exact_top(fast, lean, 1.5)
    assert abs(wanted) > 2.0 * math.pi  # it goes round at least once
    record_figure("fast top: most lean off, deg", "must hold", math.degrees(abs(most - wanted_most)), 0.5)
    record_figure("fast top: precession off", "must hold", abs(turned / wanted - 1.0), 0.05)
    assert most == pytest.approx(wanted_most, abs=math.radians(0.5))
    assert turned == pytest.approx(wanted, rel=0.05)


def test_a_slow_top_falls_over():
    slow, lean = 0.4 * sleeping_rad_s(), math.radians(2.0)
    assert exact_top(slow, lean, 1.0)[0] > math.radians(60.0)
    assert lean_of_top(slow, lean, 1.0)[0] > math.radians(44.0)
