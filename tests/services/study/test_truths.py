"""Errors of colour: FLIP by its formula, the part of a picture that is compared, and truth that no setting decides."""

import itertools

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.view import Camera, Intrinsics
from services.job.job_file import validate_job
from services.study import images, truths
from services.study.images import measure_colour
from services.study.model import knobs_of, settings_of
from services.study.truths import (
    Crop,
    cast_patch,
    colour_truth_missing,
    converged_colour,
    crop_about,
    crop_camera,
    crop_colour,
    flip_between,
)
from tests.effects.scenes import SMALL, context_of, merged
from workers.geometry.camera import look_at, project
from workers.geometry.frames import invert, transform
from workers.scene.context import Stopwatch
from workers.scene.make_scene import make_scene

HERE = truths.importlib.util.find_spec("mitsuba") is not None
traced = pytest.mark.skipif(not HERE, reason="Mitsuba is not installed: truth of colour goes untested")


def plain(color, shape=(60, 80)):
    return np.broadcast_to(np.array(color, np.uint8), (*shape, 3))


def noise(scale, seed=3):
    rng = np.random.default_rng(seed)
    return np.clip(128 + scale * rng.standard_normal((60, 80, 3)), 0, 255).astype(np.uint8)


def test_flip_is_0_for_an_image_against_itself_almost_1_for_black_against_white_and_grows_with_noise():
    black, grey, white = (plain((value, value, value)) for value in (0, 128, 255))
    assert flip_between(noise(40), noise(40).copy()) == 0.0 and 0.96 < flip_between(black, white) < 1.0
    assert flip_between(black, grey) == pytest.approx(flip_between(grey, black)) and flip_between(black, grey) > 0.4
    errors = [flip_between(grey, noise(scale)) for scale in (0.0, 2.0, 5.0, 10.0, 20.0, 40.0)]
    assert errors[0] == 0.0 and all(a < 0.8 * b for a, b in itertools.pairwise(errors))


def test_images_of_two_sizes_or_of_another_kind_are_refused_and_end_no_process():
    image = noise(10)
    others = (image[:-1], image[..., :2], image[..., 0], image.astype(np.float32))
    for one, other in (*((image, other) for other in others), (image.astype(np.float32), image)):
        with pytest.raises(ValueError, match="uint8 of one size"):
            flip_between(one, other)


def test_points_are_where_the_crop_of_the_image_has_them():
    # 80 pixels wide: a margin of 24, inside the image alone.
    assert crop_about((0.0, 0.5, 0.125, 0.5 + 20 / 480)) == Crop(0, 240 - 24, 80 + 24, 260 + 24)
    k = Intrinsics(width=320, height=360, fx=300.0, fy=280.0, cx=150.0, cy=190.0)
    camera = Camera(k, frozen_array(look_at(np.array([1.0, 1.5, 2.0]), np.zeros(3))))
    cropped = crop_camera(camera, Crop(200, 100, 400, 300))
    points = transform(invert(camera.T_world_cam), np.random.default_rng(1).uniform(-0.2, 0.2, (30, 3)))
    (u, v), (across, down) = project(points, k), project(points, cropped.intrinsics)
    assert across == pytest.approx(u * 640 / 320 - 200) and down == pytest.approx(v * 480 / 360 - 100)
    assert (cropped.intrinsics.width, cropped.intrinsics.height) == (200, 200)


def test_images_of_all_sizes_are_cropped_to_the_same_part_of_the_picture():
    """In the crop red rises evenly across and green down, by 2 and 6 for each of its pixels."""
    across, down = np.arange(100, 180) + 0.5, np.arange(60, 90) + 0.5
    for size in ((480, 640), (240, 320), (960, 1280), (720, 960)):
        v, u = ((np.arange(n) + 0.5) * full / n for n, full in zip(size, (480, 640), strict=True))
        image = np.zeros((*size, 3), np.uint8)
        image[..., 0] = np.rint(np.clip(2 * (u - 80), 0, 255))
        image[..., 1] = np.rint(np.clip(6 * (v - 54), 0, 255))[:, None]
        cut = crop_colour(image, Crop(100, 60, 180, 90)).astype(float)
        assert cut.shape == (30, 80, 3)
        assert np.abs(cut[..., 0] - 2 * (across - 80)).max() <= 1.0
        assert np.abs(cut[..., 1] - 6 * (down - 54)[:, None]).max() <= 1.0


def scene_with(**changes):
    context = context_of(validate_job(merged(SMALL, changes), "a test"))
    scene = make_scene(context, 0, Stopwatch())
    return context, scene, crop_about(cast_patch(scene.posed.things, scene.pairs[0].input.camera).box)


@pytest.mark.minute
@traced
def test_no_setting_of_the_image_decides_its_truth_whose_noise_is_far_below_what_is_measured(monkeypatch):
    """Noise falls by the root of the paths, or nearly: 4 times as many leave at most 0.75 of it."""
    own = scene_with()
    settings = (
        {"render": {"tier": "flat"}},
        {"render": {"rgb": False}},
        {"render": {"samples": 4, "path_samples": 1, "path_bounces": 2}, "sensor": {"exposure": {"stops": [1, 1]}}},
    )
    alike = [converged_colour(*made, 4) for made in (own, *(scene_with(**changes) for changes in settings))]
    assert len({truth.tobytes() for truth in alike}) == 1
    errors, by_seed = [], []
    for paths in (9, 36):
        for seed in (1, 2):
            monkeypatch.setattr(truths, "TRUTH_SEED", seed)
            by_seed.append(converged_colour(*own, paths))
        errors.append(flip_between(by_seed[-2], by_seed[-1]))
    truth = by_seed[-1]
    assert 0.0 < errors[1] < 0.75 * errors[0]
    tiers = [scene_with(render={"tier": tier})[1].pairs[0].input.rgb for tier in ("pathtraced", "raster", "flat")]
    by_tier = [flip_between(truth, crop_colour(rgb, own[2])) for rgb in tiers]
    assert by_tier == sorted(by_tier) and by_tier[1] > 4 * errors[1]


@pytest.mark.minute
def test_four_samples_are_nearer_to_smooth_edges_than_one_and_flat_light_has_no_edges_to_compare(monkeypatch):
    monkeypatch.setattr(images, "colour_truth_missing", lambda: "not here")
    context = context_of(validate_job({"name": "t", "seed": 2024, "check": {"raycast_share": 0.0}}, "a test"))
    settings, _ = settings_of(context.job, {"colour": knobs_of(context.job)["colour"]})
    settings = [each for each in settings if each.name in ("the job", "colour=raster-4", "colour=flat")]
    for scene_id in (0, 2):
        errors = {name: each["errors"] for name, each in measure_colour(context, settings, scene_id).items()}
        assert errors["colour=raster-4"]["edge_flip"] < 0.8 * errors["the job"]["edge_flip"] < 0.1
        assert errors["colour=flat"] == {}


def test_where_mitsuba_is_missing_the_message_has_the_remedy(monkeypatch):
    assert (colour_truth_missing() is None) == HERE
    monkeypatch.setattr(truths.importlib.util, "find_spec", lambda name: None)
    assert "`./verso extra pathtraced`" in str(colour_truth_missing())
