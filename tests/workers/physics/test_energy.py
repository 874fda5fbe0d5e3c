"""The energy of a falling body, against closed forms."""

import math

import numpy as np
import pytest

from workers.geometry.frames import quaternion_from_rotation, uniform_rotation
from workers.physics.bullet import GRAVITY_M_S2
from workers.physics.energy import LIFT_M, SHARE, EnergyRecord
from workers.physics.rigid_body import Body

STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
BODY = Body(2.0, np.array([1e-3, 2e-3, 4e-3]), (np.zeros((1, 3)),))


def record_of(*steps) -> float:
    """The rise over (height, velocity) in turn."""
    record = EnergyRecord([BODY], [((0.0, 0.0, steps[0][0]), UPRIGHT)], [steps[0][1]])
    for height, moving in steps[1:]:
        record.add([((0.0, 0.0, height), UPRIGHT)], [moving])
    return record.rise()


def test_a_free_fall_keeps_its_energy():
    fall = [(1.0 - d, ((0.0, 0.0, -math.sqrt(2 * GRAVITY_M_S2 * d)), (0.0, 0.0, 0.0))) for d in (0.0, 0.1, 0.5, 0.9)]
    assert record_of(*fall) == pytest.approx(0.0, abs=1e-9)


def test_a_rise_is_measured_from_the_least_so_far_and_against_all_that_was_set_free():
    heights = [1.0, 0.4, 0.4004, 0.3, 0.3003, 0.0]
    assert record_of(*((height, STILL) for height in heights)) == pytest.approx(4e-4 / (SHARE * 1.0))


def test_where_little_is_set_free_the_bound_is_a_height():
    assert record_of((0.1, STILL), (0.1 + 3 * LIFT_M, STILL)) == pytest.approx(3.0)


@pytest.mark.parametrize("seed", range(4))
def test_turning_counts_by_the_moments_along_the_bodys_axes_whatever_its_pose(seed):
    rng = np.random.default_rng(seed)
    R, spin = uniform_rotation(rng), rng.standard_normal(3)
    at = ((0.3, -0.2, 0.0), tuple(quaternion_from_rotation(R)))
    record = EnergyRecord([BODY], [at], [STILL])
    record.add([at], [((0.0, 0.0, 0.0), tuple(spin))])
    joules = spin @ (R @ np.diag(BODY.moments) @ R.T) @ spin / 2
    assert record.rise() * LIFT_M * BODY.mass_kg * GRAVITY_M_S2 == pytest.approx(joules, rel=1e-12)


def test_what_one_of_two_gains_of_the_other_is_no_rise():
    light = Body(1.0, BODY.moments, BODY.parts)
    high, low = ((0.0, 0.0, 1.0), UPRIGHT), ((0.0, 0.0, 0.0), UPRIGHT)
    record = EnergyRecord([BODY, light], [high, low], [STILL, STILL])
    record.add([low, ((0.0, 0.0, 2.0), UPRIGHT)], [STILL, STILL])
    assert record.rise() == pytest.approx(0.0)
