"""The preset of depth noise, measured on a plane that the camera faces."""

import numpy as np
import pytest

from schemas.job.captures import KinectDepthNoise
from schemas.scene.view import Camera
from workers.capture.simulate.camera import kinect_noise
from workers.capture.simulate.photograph import make_rig
from workers.scene.sensor import sense_depth


def measured(spec, z, seed=1):
    camera = Camera(make_rig(0.5).depth.intrinsics, np.eye(4))
    k = camera.intrinsics
    exact = np.full((k.height, k.width), z)
    region = np.ones(exact.shape, np.uint8)
    return sense_depth(exact, region, camera, kinect_noise(spec), np.random.default_rng(seed)) - z


def middle(error):
    """The middle of the image, where light meets the plane almost at a right angle."""
    height, width = error.shape
    return error[height // 2 - 30 : height // 2 + 30, width // 2 - 30 : width // 2 + 30]


@pytest.mark.parametrize(("z", "sigma_mm", "bias_mm"), [(0.6, 0.98, 2.1), (1.0, 1.3, 2.5), (2.0, 2.8, 3.5)])
def test_sigma_and_bias_are_the_stated_functions_of_the_distance(z, sigma_mm, bias_mm):
    error = middle(measured(KinectDepthNoise(), z))
    assert 1000.0 * error.std() == pytest.approx(sigma_mm, rel=0.05)
    assert 1000.0 * error.mean() == pytest.approx(bias_mm, abs=0.1)


def test_the_preset_lies_far_inside_what_the_maker_guarantees():
    """17 mm of random error, and 11 mm + 0.1 % of systematic error, up to 3.86 m."""
    error = middle(measured(KinectDepthNoise(), 3.5))
    assert error.std() < 0.017
    assert error.mean() < 0.011 + 0.0035


def test_times_multiplies_random_errors_alone():
    once, twice = (middle(measured(KinectDepthNoise(times=times), 0.8)) for times in (1.0, 2.0))
    assert twice.std() == pytest.approx(2.0 * once.std(), rel=1e-6)
    assert twice.mean() == pytest.approx(once.mean(), abs=2e-4)
    none = middle(measured(KinectDepthNoise(times=0.0), 0.8))
    assert none.std() == pytest.approx(0.0, abs=1e-12)


def test_shares_of_pixels_end_at_one():
    noise = kinect_noise(KinectDepthNoise(times=100.0))
    assert noise.flying_share == noise.edge_dropout == 1.0


def test_a_further_bias_is_added():
    plain, biased = (measured(KinectDepthNoise(bias_m=bias), 0.8) for bias in (0.0, 0.01))
    assert np.allclose(biased - plain, 0.01, atol=1e-12)
