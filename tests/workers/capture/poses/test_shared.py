import numpy as np
import pytest

from schemas.job.captures import Estimation
from workers.capture.poses.observation import Patches
from workers.capture.poses.terms import NAMES, Shared, identified, prior_sigma

RNG = np.random.default_rng(0)
RAY = np.column_stack([RNG.uniform(-0.3, 0.3, (9, 2)), np.ones(9)])
PATCHES = Patches(RAY * RNG.uniform(0.5, 1.2, (9, 1)), RAY, RAY, np.full(9, 9), np.full(9, 0.001))
START = Shared().moved(np.array([0.01, -0.02, 0.01, 0.02, -0.01, 0.03, -0.02, 0.01, 0.005]))


def test_derivatives_equal_finite_differences():
    exact = START.derivative(PATCHES)
    for axis in range(len(NAMES)):
        step = np.zeros(9)
        step[axis] = 1e-6
        change = START.moved(step).corrected(PATCHES) - START.moved(-step).corrected(PATCHES)
        assert exact[:, :, axis] == pytest.approx(change / 2e-6, abs=1e-7)


def test_the_correction_told_to_others_is_the_one_that_was_estimated():
    depth = START.correction(("offset_m",))
    p = PATCHES.ray_z * depth.scale + depth.offset_m * PATCHES.ray
    assert START.corrected(PATCHES) == pytest.approx(p @ depth.T_cam_depth[:3, :3].T + depth.T_cam_depth[:3, 3])
    assert depth.identified == ("offset_m",)


def test_deviations_are_what_was_added():
    step = np.array([0.01, -0.02, 0.01, 0.02, -0.01, 0.03, -0.02, 0.01, 0.005])
    assert START.deviation() == pytest.approx(step)
    assert not Shared().deviation().any()


def test_priors_hold_what_is_believed():
    by_print, by_depth = (prior_sigma(Estimation(trust=t), True) for t in ("print", "depth"))
    assert by_print[NAMES.index("print_scale")] == 0 and by_depth[NAMES.index("print_scale")] > 0.1
    assert by_depth[NAMES.index("scale")] == 0.001  # the specification of the camera
    assert not prior_sigma(Estimation(), False).any()


def test_a_parameter_is_identified_where_the_capture_says_more_than_the_prior():
    prior = prior_sigma(Estimation(), True)
    assert identified(np.where(np.arange(9) == 2, 0.1, 0.9) * prior, prior) == ("shift_x_m",)
    assert identified(prior, prior) == ()
