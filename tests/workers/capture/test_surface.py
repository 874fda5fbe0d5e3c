"""What views say about points: offsets, visibility, exposure and colour, against a plane in closed form."""

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.view import Camera
from tests.workers.capture.analytic_capture import Thing, cast, kinect
from workers.capture.surface.fusion import (
    UNSEEN,
    Sight,
    color_points,
    exposure_gains,
    measure_offsets,
    observe,
    sample_light,
)
from workers.capture.surface.posed_view import PosedView
from workers.capture.surface.tsdf import fit_depth
from workers.geometry.camera import look_at
from workers.geometry.colour import decode_codes

K = kinect(0.25)
NOTHING = Thing(sphere=None, boxes=[])
GRID = np.stack([*np.meshgrid(np.linspace(-0.08, 0.08, 9), np.linspace(-0.06, 0.06, 7))], axis=-1).reshape(-1, 2)
UP = np.tile([0.0, 0.0, 1.0], (len(GRID), 1))


def points(height_m=0.0):
    return np.concatenate([GRID, np.full((len(GRID), 1), height_m)], axis=1)


def sight(position, gain=1.0, error_m=0.0):
    camera = Camera(K, frozen_array(look_at(np.array(position), np.zeros(3))))
    depth, _, rgb = cast(NOTHING, camera)
    depth = np.where(depth > 0, depth + error_m, 0).astype(np.float32)
    rgb = np.clip(np.rint(rgb * gain), 0, 255).astype(np.uint8)
    return Sight(PosedView(0, camera, camera, rgb, depth), fit_depth(depth, K, 75.0), 0.26)


@pytest.mark.parametrize("position", [(0.02, 0.0, 0.6), (0.5, 0.2, 0.4)])
@pytest.mark.parametrize("height_m", [-0.003, 0.0, 0.004])
def test_the_offset_is_the_way_along_the_normal_to_the_surface(position, height_m):
    offset, weight = observe(points(height_m), UP, sight(position), 0.006)
    assert (weight > 0).all() and np.abs(offset + height_m).max() < 5e-5


def test_a_point_too_far_off_or_turned_away_is_not_seen():
    one = sight((0.3, 0.0, 0.5))
    assert not observe(points(0.008), UP, one, 0.006)[1].any()
    assert not observe(points(), -UP, one, 0.006)[1].any()
    assert not observe(points(), np.tile([-1.0, 0.0, 0.0], (len(GRID), 1)), one, 0.006)[1].any()


def test_offsets_are_the_weighted_mean_and_views_are_counted():
    near, far = sight((0, 0.001, 0.4), error_m=-0.001), sight((0, 0.001, 0.8), error_m=0.0005)
    found = measure_offsets(points(), UP, [near, far], 0.006)
    assert (found.views == 2).all()
    # 1.000^4 of 0.399 m against 0.8005 m; the errors lie along the vertical nearly.
    w = (0.8005 / 0.399) ** 4
    assert np.median(found.mean_m) == pytest.approx((0.001 * w - 0.0005) / (w + 1), abs=1e-4)


def test_light_is_read_between_pixels():
    one = sight((0.02, 0.0, 0.6))
    light, inside = sample_light(one.view.rgb, one.view.camera, points())
    depth, _, _ = cast(NOTHING, one.view.camera)
    assert inside.all() and (depth > 0).any()
    p = points()[10]
    wave = np.sin(40 * p + np.arange(3))
    assert np.abs(light[10] - decode_codes(np.clip(150 + 40 * wave, 0, 255).astype(np.uint8))).max() < 0.02


@pytest.mark.parametrize("seed", [0, 1])
def test_exposures_are_made_alike(seed):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.1, 0.5, (500, 3))
    gains = np.array([1.0, 0.5, 1.6, 1.0, 0.8])
    light = (truth * gains[:, None, None] * rng.normal(1, 0.02, (5, 500, 1))).astype(np.float32)
    score = (rng.uniform(size=(5, 500)) < 0.6).astype(np.float32)
    found = exposure_gains(light, score)
    assert np.allclose(found * gains / (found * gains)[0], 1.0, atol=0.02)
    assert np.median(found) == pytest.approx(1.0)


def test_a_colour_is_that_of_the_views_that_see_it_best():
    sights = [sight(p) for p in ((0.02, 0, 0.6), (0, 0.03, 0.6), (0.03, 0.03, 0.6), (0.6, 0, 0.25))]
    sights[3].view.rgb[...] = 255 - sights[3].view.rgb
    colors = color_points(points(), UP, sights, 0.006)
    wave = np.sin(40 * points() + np.arange(3))
    # A view at 67 degrees from farther away has a fiftieth of the others' squared weight.
    assert np.abs(colors.astype(float) - (150 + 40 * wave)).max() < 6


def test_a_point_that_no_view_sees_has_its_neighbours_colour():
    some = np.concatenate([points(), points(0.1)[:1]])
    colors = color_points(some, np.tile([0.0, 0.0, 1.0], (len(some), 1)), [sight((0.02, 0, 0.6))], 0.006)
    assert np.array_equal(colors[-1], colors[0])
    assert (color_points(points(0.1), UP, [sight((0.02, 0, 0.6))], 0.006) == UNSEEN).all()
