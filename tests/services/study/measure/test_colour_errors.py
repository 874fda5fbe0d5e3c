"""Errors of colour: the part of a picture that is compared, and truth that no setting of the image decides."""

import importlib.util

import numpy as np
import pytest
from services.study.measure import colour as colour_errors

from schemas.base import frozen_array
from schemas.scene.view import Camera, Intrinsics
from services.job.job_file import validate_job
from services.study.colour import (
    ColourTruth,
    Crop,
    colour_truth_missing,
    converged_colour,
    crop_about,
    crop_camera,
    crop_colour,
    flip_error,
)
from tests.effects.scenes import SMALL, context_of, merged
from workers.geometry.camera import look_at, project
from workers.geometry.frames import invert, transform
from workers.scene.context import Stopwatch
from workers.scene.make_scene import make_scene

HERE = importlib.util.find_spec("mitsuba") is not None
traced = pytest.mark.skipif(not HERE, reason="Mitsuba is not installed: truth of colour goes untested")


def noise(scale, seed=3):
    rng = np.random.default_rng(seed)
    return np.clip(128 + scale * rng.standard_normal((60, 80, 3)), 0, 255).astype(np.uint8)


# ---------------------------------------------------------------------------------------------- what is compared


def test_a_box_at_a_corner_gets_a_margin_inside_the_image_alone():
    crop = crop_about((0.0, 0.5, 0.125, 0.5 + 20 / 480))  # 80 pixels wide: a margin of 24
    assert crop == Crop(0, 240 - 24, 80 + 24, 260 + 24)


def test_points_are_where_the_crop_of_the_image_has_them():
    k = Intrinsics(width=320, height=360, fx=300.0, fy=280.0, cx=150.0, cy=190.0)
    camera = Camera(k, frozen_array(look_at(np.array([1.0, 1.5, 2.0]), np.zeros(3))))
    crop = Crop(200, 100, 400, 300)
    cropped = crop_camera(camera, crop)
    points = transform(invert(camera.T_world_cam), np.random.default_rng(1).uniform(-0.2, 0.2, (30, 3)))
    (u, v), (across, down) = project(points, k), project(points, cropped.intrinsics)
    assert across == pytest.approx(u * 640 / 320 - 200) and down == pytest.approx(v * 480 / 360 - 100)
    assert (cropped.intrinsics.width, cropped.intrinsics.height) == (200, 200)


@pytest.mark.parametrize("size", [(480, 640), (240, 320), (960, 1280), (720, 960)])
def test_images_of_all_sizes_are_cropped_to_the_same_part_of_the_picture(size):
    """In the crop red rises evenly across and green down, by 2 and 6 for each of its pixels."""
    v, u = ((np.arange(n) + 0.5) * full / n for n, full in zip(size, (480, 640), strict=True))
    image = np.zeros((*size, 3), np.uint8)
    image[..., 0], image[..., 1] = (
        np.rint(np.clip(2 * (u - 80), 0, 255)),
        np.rint(np.clip(6 * (v - 54), 0, 255))[:, None],
    )
    cut = crop_colour(image, Crop(100, 60, 180, 90)).astype(float)
    across, down = np.arange(100, 180) + 0.5, np.arange(60, 90) + 0.5
    assert cut.shape == (30, 80, 3)
    assert np.abs(cut[..., 0] - 2 * (across - 80)).max() <= 1.0
    assert np.abs(cut[..., 1] - 6 * (down - 54)[:, None]).max() <= 1.0


def test_only_the_crop_is_compared():
    image = noise(20).repeat(8, axis=0).repeat(8, axis=1)
    truth = ColourTruth(Crop(100, 60, 180, 90), image[60:90, 100:180])
    other = 255 - image
    other[60:90, 100:180] = image[60:90, 100:180]
    assert flip_error(truth, other) == 0.0
    assert flip_error(truth, 255 - image) > 0.1


# ---------------------------------------------------------------------------------------------- the truth


def scene_with(**changes):
    job = validate_job(merged(SMALL, changes), "a test")
    context = context_of(job)
    return context, make_scene(context, 0, Stopwatch())


@pytest.fixture(scope="module")
def plain_scene():
    return scene_with()


@pytest.fixture(scope="module")
def truth(plain_scene):
    return converged_colour(*plain_scene, 36)


@traced
def test_neither_tier_nor_samples_nor_noise_of_the_image_decide_its_truth(plain_scene):
    truths = [converged_colour(*plain_scene, 4)] + [
        converged_colour(*scene_with(**changes), 4)
        for changes in (
            {"render": {"tier": "flat"}},
            {"render": {"rgb": False}},
            {"render": {"samples": 4, "path_samples": 1, "path_bounces": 2}, "sensor": {"exposure": {"stops": [1, 1]}}},
        )
    ]
    assert len({truth.rgb.tobytes() for truth in truths}) == 1
    assert len({truth.crop for truth in truths}) == 1


@traced
def test_the_truth_s_own_noise_falls_with_paths_and_is_far_below_what_is_measured(plain_scene, truth):
    """By the root of the paths, or nearly: 4 times as many leave at most 0.7 of it."""
    few, many = (
        flip_error(one, _whole(converged_colour(*plain_scene, paths, salt=1)))
        for paths, one in ((9, converged_colour(*plain_scene, 9)), (36, truth))
    )
    assert 0.0 < many < 0.75 * few
    assert flip_error(truth, plain_scene[1].pairs[0].input.rgb) > 4 * many


def _whole(truth):
    image = np.zeros((480, 640, 3), np.uint8)
    image[truth.crop.top : truth.crop.bottom, truth.crop.left : truth.crop.right] = truth.rgb
    return image


@traced
def test_the_path_traced_tier_is_nearest_to_its_truth_and_the_flat_one_farthest(plain_scene, truth):
    raster = flip_error(truth, plain_scene[1].pairs[0].input.rgb)
    flat = flip_error(truth, scene_with(render={"tier": "flat"})[1].pairs[0].input.rgb)
    traced = flip_error(truth, scene_with(render={"tier": "pathtraced"})[1].pairs[0].input.rgb)
    assert traced < raster < flat


def test_where_mitsuba_is_missing_the_remedy_is_told(monkeypatch):
    assert (colour_truth_missing() is None) == HERE
    monkeypatch.setattr(colour_errors.importlib.util, "find_spec", lambda name: None)
    assert "`./verso extra pathtraced`" in colour_truth_missing()
