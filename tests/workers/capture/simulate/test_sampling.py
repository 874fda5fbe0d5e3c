"""The samples of a photograph, and their sum in linear light."""

import numpy as np
import pytest

from schemas.scene.view import Intrinsics
from workers.capture.simulate.camera import SAMPLES, add_light, light_table, make_samples, shift_camera
from workers.geometry.colour import decode_srgb


def table():
    return np.array([(s.right_px, s.down_px, s.moment) for s in make_samples()])


def test_samples_are_spread_evenly_over_columns_rows_and_moments():
    for values in table().T:
        assert np.allclose(np.sort(values), (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5)


def test_the_mean_sample_is_the_pixels_centre_at_the_exposures_middle():
    samples = table()
    assert np.abs(samples.mean(axis=0)).max() < 1e-15
    assert (samples[SAMPLES // 2] == 0.0).all()
    assert np.allclose(samples, -samples[::-1])  # odd moments vanish: a straight edge is not displaced
    assert np.allclose(np.corrcoef(samples.T), np.eye(3), atol=1e-12)


def test_a_shifted_camera_sees_its_sample_at_the_pixels_centre():
    k = Intrinsics(width=10, height=10, fx=8.0, fy=9.0, cx=5.2, cy=4.9)
    sample = make_samples()[0]
    moved = shift_camera(k, sample)
    assert (3.5 - moved.cx) / moved.fx == pytest.approx((3.5 + sample.right_px - k.cx) / k.fx)
    assert (7.5 - moved.cy) / moved.fy == pytest.approx((7.5 + sample.down_px - k.cy) / k.fy)


def test_light_is_averaged_before_it_is_encoded():
    total = np.zeros((1, 1, 3))
    for n in range(SAMPLES):
        add_light(total, np.full((1, 1, 3), 255 if n < 3 else 40, np.uint8), light_table(SAMPLES))
    assert total == pytest.approx((3.0 + 6.0 * decode_srgb(np.array(40 / 255.0))) / 9.0, rel=1e-12)
