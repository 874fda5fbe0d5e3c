"""Noise of a depth camera; colour through a lens, an exposure and a noisy sensor: against formulas and what can be counted."""

import math

import cv2
import numpy as np
import pytest

from schemas.job.views import DepthNoise, Distortion, Exposure, Images, RgbNoise, SensorEffects
from schemas.scene.scene import EffectPlan
from schemas.scene.view import Camera, Intrinsics, View
from workers.geometry.colour import decode_codes as decode
from workers.scene.sensor import (
    SensorChance,
    add_noise,
    distort,
    expose,
    near_edge,
    sense_depth,
    sense_rgb,
    sense_view,
)

K = Intrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=80.0, cy=60.0)
CAMERA = Camera(K, np.eye(4))
PRESET = DepthNoise()
QUIET = DepthNoise(axial_per_m=0.0, lateral_px=0.0, flying_share=0.0, edge_dropout=0.0, range_m=(0.0, 100.0))
"""Every effect off; tests switch on the one that they look at."""
INNER = (slice(5, -5), slice(5, -5))
AWAY = np.r_[0:70, 90:160]
"""Columns away from the edge of `step`."""
LENS = Distortion(k1=-0.2, k2=0.05, p1=0.002, p2=-0.001, k3=0.01)
EVERY = {
    "depth_noise": {},
    "distortion": {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.001},
    "rgb_noise": {},
    "exposure": {},
}
NAMES = tuple(f"sensor_{name}" for name in EVERY)


def seeded(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def plane(distance_m: float, tilt_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] of a plane `distance_m` ahead, turned about x; and the exact cosine of incidence of each ray."""
    rows, columns = np.mgrid[0:120, 0:160]
    rays = np.stack([(columns + 0.5 - 80.0) / 150.0, (rows + 0.5 - 60.0) / 150.0, np.ones((120, 160))], axis=2)
    normal = np.array([0.0, math.sin(math.radians(tilt_deg)), -math.cos(math.radians(tilt_deg))])
    along = rays @ normal
    return normal[2] * distance_m / along, -along / np.linalg.norm(rays, axis=2)


def step(near_m: float = 1.0, far_m: float = 2.0) -> np.ndarray:
    """A wall at `near_m` in the left half before one at `far_m`."""
    return np.where(np.arange(160)[None, :] < 80, near_m, far_m) * np.ones((120, 1))


def sense(depth: np.ndarray, noise: DepthNoise = QUIET, seed: int = 1, **changes) -> np.ndarray:
    noise = noise.model_copy(update=changes)
    return sense_depth(depth, np.ones((120, 160), np.uint8), CAMERA, noise, seeded(seed))


def is_uniform(values: np.ndarray) -> bool:
    """Kolmogorov-Smirnov at the 0.1 % level, of values between 0 and 1."""
    n = len(values)
    return bool(np.abs(np.sort(values) - (np.arange(n) + 0.5) / n).max() < 1.95 / math.sqrt(n))


# ---------------------------------------------------------------------------------------------- depth


def test_noise_on_a_plane_has_the_spread_of_the_preset_which_grows_with_distance_and_angle():
    """17 mm at 3.86 m, growing with z squared and with 1 / cos: the sum of squares is chi-square distributed."""
    spreads = {}
    for at in ((0.8, 0.0), (1.5, 0.0), (3.0, 0.0), (1.5, 40.0), (1.5, 60.0)):
        z, cosine = plane(*at)
        sensed = sense(z, PRESET)
        kept = (sensed > 0.0)[INNER] & (z < 3.6)[INNER] & (z > 0.6)[INNER]
        score = ((sensed - z) * cosine / (0.017 * (z / 3.86) ** 2))[INNER][kept]
        n = len(score)
        assert n > 5000
        assert abs((score**2).sum() - n) < 4.5 * math.sqrt(2 * n)
        assert abs(score.mean()) < 4.5 / math.sqrt(n)
        spreads[at] = (sensed - z)[55:65, 5:-5].std()
    assert spreads[1.5, 0.0] * 3.0 < spreads[3.0, 0.0]  # four times, by the square
    assert spreads[1.5, 0.0] * 1.6 < spreads[1.5, 60.0]  # twice, by the cosine


def test_grazing_surfaces_and_what_is_out_of_range_have_no_depth_and_others_keep_theirs():
    z, cosine = plane(1.5, 70.0)
    sensed = sense(z, grazing_deg=65.0)
    known = (slice(2, -2), slice(2, -2))
    degrees = np.degrees(np.arccos(cosine))[known]
    assert (degrees > 65.5).any() and (degrees < 64.5).any()
    assert (sensed[known][degrees > 65.5] == 0.0).all()
    assert np.array_equal(sensed[known][degrees < 64.5], z[known][degrees < 64.5])
    assert (sense(step(0.45, 4.2), PRESET)[:, AWAY] == 0.0).all()
    hole = step()
    hole[30:60, 60:100] = 0.0
    sensed = sense(hole, DepthNoise(offset_m=0.5, lateral_px=3.0, flying_share=0.9, edge_px=3))
    assert (sensed[30:60, 60:100] == 0.0).all() and (sensed > 0.0).any()


def test_flying_lost_and_shifted_pixels_lie_at_an_edge_and_have_the_shares_asked_for():
    depth, n = step(), 2 * 120
    for reach in (1, 3):
        sensed = sense(depth, flying_share=1.0, edge_px=reach)
        changed = sensed != depth
        columns = np.flatnonzero(changed.any(axis=0))
        assert columns.tolist() == list(range(80 - reach, 80 + reach)) and changed[:, columns].all()
        assert sensed[changed].min() > 1.0 and sensed[changed].max() < 2.0
        assert is_uniform(sensed[changed] - 1.0)  # the mixture is uniform between the two
    swapped = sense(depth, lateral_px=0.5)
    assert set(np.unique(swapped)) == {1.0, 2.0}
    assert set(np.flatnonzero((swapped != depth).any(axis=0))) == {79, 80}
    for count, share in (
        ((sense(depth, flying_share=0.3) != depth).sum(), 0.3),
        ((sense(depth, edge_dropout=0.2) == 0.0).sum(), 0.2),
        ((swapped != depth).sum(), 0.15866),  # towards the other surface: a normal deviate beyond one sigma
    ):
        assert abs(count - share * n) < 4 * math.sqrt(n * share * (1 - share))
    assert near_edge(depth, PRESET).any()
    assert not near_edge(plane(2.0, 60.0)[0], PRESET).any() and not near_edge(step(1.0, 1.01), PRESET).any()


def test_the_systematic_error_is_an_offset_and_a_share_of_the_distance_and_without_effects_depth_is_the_same():
    sensed = sense(np.full((120, 160), 2.0), offset_m=0.011, offset_share=0.001)
    assert sensed == pytest.approx(np.full((120, 160), 2.0 * 1.001 + 0.011), abs=1e-12)
    for depth in (plane(1.5, 40.0)[0], step()):
        assert np.array_equal(sense(depth), depth)


def test_one_seed_is_one_image_and_switching_an_effect_off_moves_no_other_noise():
    sensed = sense(step(), PRESET)
    assert np.array_equal(sensed, sense(step(), PRESET))
    assert not np.array_equal(sensed, sense(step(), PRESET, seed=2))
    calm = sense(step(), PRESET, flying_share=0.0, edge_dropout=0.0, lateral_px=0.0)
    assert np.array_equal(sensed[:, AWAY], calm[:, AWAY])


# ---------------------------------------------------------------------------------------------- colour


def test_one_stop_doubles_linear_light_up_to_white_and_stops_are_drawn_over_the_whole_range_one_a_picture():
    light = np.linspace(0.0, 1.0, 101)
    up, down = (expose(light, Exposure(stops=(stops, stops)), seeded()) for stops in (1.0, -1.0))
    assert up == pytest.approx(np.minimum(2.0 * light, 1.0)) and down == pytest.approx(0.5 * light)
    light = np.full((4, 4, 3), 0.1)
    gains = [expose(light, Exposure(stops=(-1.0, 2.0)), seeded(seed)) / light for seed in range(400)]
    assert all(np.ptp(gain) < 1e-12 for gain in gains)
    assert is_uniform((np.log2([gain.flat[0] for gain in gains]) + 1.0) / 3.0)


def test_the_variance_of_shot_noise_is_proportional_to_the_mean():
    """In electrons the variance is the mean, and read noise adds its square."""
    noise = RgbNoise(full_well_e=2000.0, read_noise_e=5.0)
    for mean in (0.02, 0.1, 0.4, 0.8):
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
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    for column in (30, 120):
        near, rows = np.arange(column - 12, column + 13), np.arange(15, 105, 5)
        weight = seen[rows][:, near]
        points = np.stack([(weight * near).sum(axis=1) / weight.sum(axis=1), rows], axis=1)
        ideal = cv2.undistortPoints(points[:, None], matrix, coefficients, None, matrix, criteria=criteria)
        assert np.abs(ideal[:, 0, 0] - column).max() < 0.1  # a centroid of two or three pixels
        assert np.abs(points[:, 0] - column).max() > 0.5  # and the lens did bend it
    plain = seeded().random((120, 160, 3))
    assert distort(plain, Distortion(), K) == pytest.approx(plain, abs=1e-9)


def test_one_seed_is_one_picture_exposure_has_a_chance_of_its_own_and_with_everything_off_rgb_is_the_same_array():
    def see(rgb, seed=1, **effects):
        return sense_rgb(rgb, K, SensorEffects(**effects), seeded(seed), seeded(seed + 100))

    rgb, still = np.full((120, 160, 3), 120, np.uint8), {"exposure": {"stops": [0.0, 0.0]}}
    assert see(rgb) is rgb and np.array_equal(see(rgb, **still), rgb)
    every = {"distortion": LENS, "rgb_noise": {}, "exposure": {}}
    assert np.array_equal(see(rgb, **every), see(rgb, **every))
    assert not np.array_equal(see(rgb, **every), see(rgb, seed=2, **every))
    assert np.array_equal(see(rgb, rgb_noise={}, **still), see(rgb, rgb_noise={}))


# ---------------------------------------------------------------------------------------------- a view, by the plan


def exact_view() -> View:
    """A wall that recedes, with a step in it, in grey stripes."""
    k = Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)
    depth = np.tile(np.linspace(6_000, 8_000, 64).astype(np.uint16), (48, 1))
    depth[:, 40:] += 3_000
    rgb = np.repeat(np.tile(np.arange(20, 148, 2, dtype=np.uint8), (48, 1))[..., None], 3, axis=2)
    return View("input", 0, 0, Camera(k, np.eye(4)), rgb, depth, np.where(depth > 9_000, 2, 3).astype(np.uint8), ())


def sensed(names: tuple[str, ...], view: View | None = None, **branches: object) -> View:
    """The view as the sensors store it, with these effects in the plan and always the same chance."""
    chance = SensorChance(*(seeded(seed) for seed in (1, 2, 3)))
    sensor = SensorEffects.model_validate({**EVERY, **branches})
    return sense_view(sensor, Images(), view or exact_view(), chance, EffectPlan(names, {}))


def test_an_effect_runs_because_the_plan_has_it_and_changes_what_its_number_says():
    exact, full = exact_view(), sensed(NAMES)
    for name in EVERY:
        less = sensed(tuple(other for other in NAMES if other != f"sensor_{name}"))
        off = sensed(NAMES, **{name: None})
        assert np.array_equal(less.rgb, off.rgb) and np.array_equal(less.depth, off.depth)
        assert np.array_equal(full.depth, less.depth) == (name != "depth_noise")
        assert np.array_equal(full.rgb, less.rgb) == (name == "depth_noise")
        assert full.region.tobytes() == less.region.tobytes() == exact.region.tobytes()
    seen = sensed(("sensor_exposure",), exposure={"stops": [1.0, 1.0]})
    assert np.array_equal(seen.depth, exact.depth)
    assert np.abs(decode(seen.rgb) - np.minimum(2.0 * decode(exact.rgb), 1.0)).max() < 0.006
    assert sensed((), exact) is exact
