"""Noise of a time-of-flight depth camera, against its formula and against what can be counted."""

import math

import numpy as np
import pytest

from schemas.job.views import DepthNoise
from schemas.scene.view import Camera, Intrinsics
from workers.scene.sensor import near_edge, sense_depth

K = Intrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=80.0, cy=60.0)
CAMERA = Camera(K, np.eye(4))
ONE = np.ones((120, 160), np.uint8)
PRESET = DepthNoise()
QUIET = DepthNoise(axial_per_m=0.0, lateral_px=0.0, flying_share=0.0, edge_dropout=0.0, range_m=(0.0, 100.0))
"""Every effect off; tests switch on the one that they look at."""


def rays() -> np.ndarray:
    """[H, W, 3] towards the pixel centres at z = 1."""
    rows, columns = np.mgrid[0:120, 0:160]
    return np.stack([(columns + 0.5 - 80.0) / 150.0, (rows + 0.5 - 60.0) / 150.0, np.ones((120, 160))], axis=2)


def plane(distance_m: float, tilt_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] of a plane `distance_m` ahead, turned about x; and the exact cosine of incidence of each ray."""
    normal = np.array([0.0, math.sin(math.radians(tilt_deg)), -math.cos(math.radians(tilt_deg))])
    along = rays() @ normal
    z = normal[2] * distance_m / along
    return z, -along / np.linalg.norm(rays(), axis=2)


def step(near_m: float = 1.0, far_m: float = 2.0) -> np.ndarray:
    """A wall at `near_m` in the left half before one at `far_m`."""
    return np.where(np.arange(160)[None, :] < 80, near_m, far_m) * np.ones((120, 1))


def sense(depth: np.ndarray, noise: DepthNoise, seed: int = 1) -> np.ndarray:
    return sense_depth(depth, ONE, CAMERA, noise, np.random.default_rng(seed))


@pytest.mark.parametrize(("distance_m", "tilt_deg"), [(0.8, 0.0), (1.5, 0.0), (3.0, 0.0), (1.5, 40.0), (1.5, 60.0)])
def test_noise_on_a_plane_has_the_spread_of_the_preset(distance_m, tilt_deg):
    """17 mm at 3.86 m, growing with z squared and with 1 / cos: the sum of squares is chi-square distributed."""
    z, cosine = plane(distance_m, tilt_deg)
    inner = (slice(5, -5), slice(5, -5))
    sigma = 0.017 * (z / 3.86) ** 2 / cosine
    found = sense(z, PRESET)
    kept = (found > 0.0)[inner] & (z < 3.6)[inner] & (z > 0.6)[inner]
    score = ((found - z) / sigma)[inner][kept]
    n = len(score)
    assert n > 5000
    assert abs((score**2).sum() - n) < 4.5 * math.sqrt(2 * n)
    assert abs(score.mean()) < 4.5 / math.sqrt(n)


def test_noise_grows_with_distance_and_with_the_angle():
    def spread(distance_m, tilt_deg):
        z, _ = plane(distance_m, tilt_deg)
        middle = (slice(55, 65), slice(5, -5))
        return (sense(z, PRESET) - z)[middle].std()

    assert spread(1.0, 0.0) * 3.0 < spread(2.0, 0.0)  # four times, by the square
    assert spread(1.5, 0.0) * 1.6 < spread(1.5, 60.0)  # twice, by the cosine


def test_grazing_surfaces_have_no_depth_and_others_keep_theirs():
    z, cosine = plane(1.5, 70.0)
    found = sense(z, QUIET.model_copy(update={"grazing_deg": 65.0}))
    known = (slice(2, -2), slice(2, -2))
    degrees = np.degrees(np.arccos(cosine))[known]
    assert (degrees > 65.5).any()
    assert (degrees < 64.5).any()
    assert (found[known][degrees > 65.5] == 0.0).all()
    assert np.array_equal(found[known][degrees < 64.5], z[known][degrees < 64.5])


@pytest.mark.parametrize("reach", [1, 3])
def test_flying_pixels_lie_near_an_edge_and_between_its_depths(reach):
    depth = step()
    found = sense(depth, QUIET.model_copy(update={"flying_share": 1.0, "edge_px": reach}))
    changed = found != depth
    columns = np.flatnonzero(changed.any(axis=0))
    assert columns.tolist() == list(range(80 - reach, 80 + reach))
    assert changed[:, columns].all()
    assert found[changed].min() > 1.0
    assert found[changed].max() < 2.0
    # Kolmogorov-Smirnov at the 0.1 % level: the mixture is uniform between the two.
    mixed = np.sort(found[changed]) - 1.0
    assert np.abs(mixed - (np.arange(len(mixed)) + 0.5) / len(mixed)).max() < 1.95 / math.sqrt(len(mixed))


def test_the_shares_of_flying_and_of_lost_pixels_are_those_asked_for():
    depth, n = step(), 2 * 120
    flying = (sense(depth, QUIET.model_copy(update={"flying_share": 0.3})) != depth).sum()
    lost = (sense(depth, QUIET.model_copy(update={"edge_dropout": 0.2})) == 0.0).sum()
    assert abs(flying - 0.3 * n) < 4 * math.sqrt(n * 0.3 * 0.7)
    assert abs(lost - 0.2 * n) < 4 * math.sqrt(n * 0.2 * 0.8)


def test_lateral_jitter_only_swaps_the_two_surfaces_at_an_edge():
    depth = step()
    found = sense(depth, QUIET.model_copy(update={"lateral_px": 0.5}))
    changed = found != depth
    assert set(np.unique(found)) == {1.0, 2.0}
    assert set(np.flatnonzero(changed.any(axis=0))) == {79, 80}
    # One pixel aside, towards the other surface: a normal deviate beyond half a pixel, that is one sigma.
    share = 0.15866
    assert abs(changed.sum() - share * 240) < 4 * math.sqrt(240 * share * (1 - share))


def test_a_slanted_plane_has_no_edge_and_a_step_has():
    assert not near_edge(plane(2.0, 60.0)[0], PRESET).any()
    assert near_edge(step(), PRESET).any()
    assert not near_edge(step(1.0, 1.01), PRESET).any()


def test_the_systematic_error_is_an_offset_and_a_share_of_the_distance():
    depth = np.full((120, 160), 2.0)
    found = sense(depth, QUIET.model_copy(update={"offset_m": 0.011, "offset_share": 0.001}))
    assert found == pytest.approx(np.full((120, 160), 2.0 * 1.001 + 0.011), abs=1e-12)


def test_no_depth_stays_no_depth_whatever_is_on():
    depth = step()
    depth[30:60, 60:100] = 0.0
    found = sense(depth, DepthNoise(offset_m=0.5, lateral_px=3.0, flying_share=0.9, edge_px=3))
    assert (found[30:60, 60:100] == 0.0).all()
    assert (found > 0.0).any()


def test_nothing_is_measured_outside_the_operating_range():
    found = sense(step(0.45, 4.2), PRESET)
    away = np.r_[0:70, 90:160]
    assert (found[:, away] == 0.0).all()


def test_with_every_effect_off_depth_is_the_same():
    z, _ = plane(1.5, 40.0)
    assert np.array_equal(sense(z, QUIET), z)
    assert np.array_equal(sense(step(), QUIET), step())


def test_one_seed_is_one_image_and_switching_an_effect_off_moves_no_other_noise():
    depth = step()
    assert np.array_equal(sense(depth, PRESET), sense(depth, PRESET))
    assert not np.array_equal(sense(depth, PRESET), sense(depth, PRESET, seed=2))
    calm = sense(depth, PRESET.model_copy(update={"flying_share": 0.0, "edge_dropout": 0.0, "lateral_px": 0.0}))
    away = np.r_[0:70, 90:160]
    assert np.array_equal(sense(depth, PRESET)[:, away], calm[:, away])
