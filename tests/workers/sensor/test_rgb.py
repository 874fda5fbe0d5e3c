"""RGB through a lens, an exposure and a noisy sensor."""

import math

import cv2
import numpy as np
import pytest

from schemas.job.views import Distortion, Exposure, RgbNoise, SensorEffects
from schemas.scene.view import Intrinsics
from workers.geometry.colour import decode_codes as decode
from workers.geometry.colour import encode_codes as encode
from workers.scene.sensor import add_noise, distort, expose, sense_rgb

K = Intrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=80.0, cy=60.0)
LENS = Distortion(k1=-0.2, k2=0.05, p1=0.002, p2=-0.001, k3=0.01)


def seeded(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def sense(rgb: np.ndarray, seed: int = 1, **effects) -> np.ndarray:
    return sense_rgb(rgb, K, SensorEffects(**effects), seeded(seed), seeded(seed + 100))


def test_every_code_comes_back_from_linear_light():
    codes = np.arange(256, dtype=np.uint8)
    assert np.array_equal(encode(decode(codes)), codes)
    # IEC 61966-2-1's own figures: half of linear light is code 187.5, code 10 lies on the straight part.
    assert decode(np.uint8([188, 10])) == pytest.approx([0.5029, 10 / 255 / 12.92], abs=1e-4)
    assert encode(np.array([-0.1, 0.0, 1.0, 1.5])).tolist() == [0, 0, 255, 255]


def test_one_stop_doubles_linear_light_up_to_white():
    light = np.linspace(0.0, 1.0, 101)
    up, down = (expose(light, Exposure(stops=(stops, stops)), seeded()) for stops in (1.0, -1.0))
    assert up[:51] == pytest.approx(2.0 * light[:51])
    assert (up[51:] == 1.0).all()
    assert down == pytest.approx(0.5 * light)


def test_exposure_is_drawn_over_the_whole_range_and_is_one_for_a_picture():
    light = np.full((4, 4, 3), 0.1)
    gains = [expose(light, Exposure(stops=(-1.0, 2.0)), seeded(seed)) / light for seed in range(400)]
    assert all(np.ptp(gain) < 1e-12 for gain in gains)
    stops = np.sort([math.log2(gain.flat[0]) for gain in gains])
    assert np.abs((stops + 1.0) / 3.0 - (np.arange(400) + 0.5) / 400).max() < 1.95 / math.sqrt(400)


@pytest.mark.parametrize("mean", [0.02, 0.1, 0.4, 0.8])
def test_the_variance_of_shot_noise_is_proportional_to_the_mean(mean):
    """In electrons the variance is the mean, and read noise adds its square."""
    noise = RgbNoise(full_well_e=2000.0, read_noise_e=5.0)
    electrons = add_noise(np.full((200, 200), mean), noise, seeded()) * 2000.0
    n, variance = electrons.size, mean * 2000.0 + 25.0
    assert abs(electrons.mean() - mean * 2000.0) < 4.5 * math.sqrt(variance / n)
    assert abs(electrons.var() / variance - 1.0) < 4.5 * math.sqrt(2.0 / n)


def test_a_straight_line_lands_where_opencv_says_that_the_lens_draws_it():
    """Bright lines seen through the lens, undone with OpenCV's own undistortPoints, are straight again."""
    light = np.zeros((120, 160, 3))
    light[:, 30] = light[:, 120] = 1.0
    seen = distort(light, LENS, K)[..., 0]
    matrix = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
    coefficients = np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2, LENS.k3])
    for column in (30, 120):
        points = []
        for row in range(15, 105, 5):
            near = slice(column - 12, column + 13)
            weight = seen[row, near]
            points.append((float((np.arange(160)[near] * weight).sum() / weight.sum()), float(row)))
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        ideal = cv2.undistortPoints(np.array(points)[:, None], matrix, coefficients, None, matrix, criteria=criteria)
        assert np.abs(ideal[:, 0, 0] - column).max() < 0.1  # a centroid of two or three pixels
        assert np.abs(np.array(points)[:, 0] - column).max() > 0.5  # and the lens did bend it


def test_without_distortion_the_lens_shows_the_same_picture():
    light = seeded().random((120, 160, 3))
    assert distort(light, Distortion(), K) == pytest.approx(light, abs=1e-9)


def test_with_everything_off_rgb_is_the_same_array():
    rgb = seeded().integers(0, 256, (120, 160, 3)).astype(np.uint8)
    assert sense(rgb) is rgb
    assert np.array_equal(sense(rgb, exposure={"stops": [0.0, 0.0]}), rgb)


def test_one_seed_is_one_picture_and_exposure_has_a_chance_of_its_own():
    rgb = np.full((120, 160, 3), 120, np.uint8)
    every = {"distortion": LENS, "rgb_noise": {}, "exposure": {}}
    assert np.array_equal(sense(rgb, **every), sense(rgb, **every))
    assert not np.array_equal(sense(rgb, **every), sense(rgb, seed=2, **every))
    fixed = sense(rgb, rgb_noise={}, exposure={"stops": [0.0, 0.0]})
    assert np.array_equal(fixed, sense(rgb, rgb_noise={}))
