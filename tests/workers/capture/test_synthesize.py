"""Synthesised views, held against exact views from poses that were not captured."""

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.errors import CaptureError
from schemas.job.captures import Synthesis
from schemas.scene.view import Camera
from tests.workers.capture.analytic_capture import Thing, capture, cast, kinect, poses
from workers.capture.surface.synthesize import merge_layers, rank_views, synthesize_view
from workers.capture.surface.tsdf import fit_depth
from workers.capture.surface.warp import Layer, prepare_source
from workers.geometry.camera import look_at

K = kinect(0.25)
THING = Thing()


def sources(sigma_m, count=24, seed=0):
    found = []
    for view in capture(THING, count=count, sigma_m=sigma_m, seed=seed):
        mask = cast(THING, view.camera)[1]
        found.append(prepare_source(view, fit_depth(view.depth_m, K, 75.0), mask))
    return found


@pytest.mark.parametrize(("sigma_m", "seed"), [(0.0, 0), (0.002, 1), (0.004, 2)])
def test_a_view_from_a_held_out_pose_is_the_true_one(sigma_m, seed, record_figure):
    ready = sources(sigma_m, seed=seed)
    worst = 0.0
    for T in poses(5, 0.75, seed=70 + seed):
        camera = Camera(K, frozen_array(T))
        view = synthesize_view(ready, camera, Synthesis())
        depth, mask, rgb = cast(THING, camera)
        both = (view.depth_m > 0) & view.mask & mask
        worst = max(worst, float(np.median(np.abs(view.depth_m - depth)[both])) * 1e3)
        assert both.sum() > 0.9 * mask.sum()
        assert (view.mask & ~mask).sum() < 0.03 * mask.sum()
        assert np.median(np.abs(view.rgb.astype(int) - rgb)[both]) <= 3
        assert 0.97 < view.measured_share <= 1.0
        assert len(view.sources) == 6
    record_figure(f"synthesised depth, noise {sigma_m * 1e3:g} mm", "median, mm", worst, 1.0)
    assert worst < 1.0


def test_views_are_ranked_by_the_cosine_of_their_axes():
    camera = Camera(K, frozen_array(look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))))
    axes = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 0.0, -1.0], [-0.6, 0.0, -0.8], [1.0, 0.0, 0.0]])
    assert list(rank_views(axes, camera)) == [2, 1, 3, 4, 0]


def test_the_nearest_surface_is_averaged_and_one_behind_it_is_not():
    layers = [layer(1.000, 1.0, 10), layer(1.002, 3.0, 50), layer(1.2, 9.0, 250)]
    rgb, depth, _ = merge_layers(layers, Camera(tiny(), np.eye(4)))
    assert np.allclose(depth, 1.0015) and (rgb == 40).all()


def test_what_a_surface_seen_from_behind_hides_is_empty():
    hidden = merge_layers([layer(1.0, 1.0, 10), layer(0.8, 0.0, 0)], Camera(tiny(), np.eye(4)))[1]
    open_ = merge_layers([layer(1.0, 1.0, 10), layer(1.1, 0.0, 0)], Camera(tiny(), np.eye(4)))[1]
    assert not hidden.any() and np.allclose(open_, 1.0)


def test_a_camera_that_sees_nothing_is_refused():
    away = Camera(K, frozen_array(look_at(np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.0, 2.0]))))
    with pytest.raises(CaptureError, match="shows anything to this camera") as refusal:
        synthesize_view(sources(0.0, count=4), away, Synthesis())
    assert refusal.value.reason == "nothing_seen"


def tiny():
    return K.model_copy(update={"width": 4, "height": 3})


def layer(depth_m, weight, code):
    return Layer(
        np.full((3, 4), depth_m, np.float32),
        np.full((3, 4), weight, np.float32),
        np.full((3, 4, 3), code, np.uint8),
        np.ones((3, 4), bool),
    )
