"""One view seen from elsewhere, held against exact depth."""

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.view import Camera
from tests.workers.capture.analytic_capture import Thing, cast, kinect
from workers.capture.surface.posed_view import PosedView
from workers.capture.surface.tsdf import fit_depth
from workers.capture.surface.warp import move_depth, prepare_source, warp
from workers.geometry.camera import look_at
from workers.geometry.frames import translation

K = kinect(0.25)
THING = Thing()


def camera_at(*position):
    return Camera(K, frozen_array(look_at(np.array(position), np.array([0.0, 0.0, 0.04]))))


def source_of(camera, depth_camera=None):
    depth_camera = depth_camera or camera
    depth, mask, _ = cast(THING, depth_camera)
    view = PosedView(0, camera, depth_camera, cast(THING, camera)[2], depth.astype(np.float32))
    return prepare_source(view, fit_depth(view.depth_m, K, 75.0), mask)


SOURCE = source_of(camera_at(0.5, 0.1, 0.45))


@pytest.mark.parametrize("position", [(0.5, 0.1, 0.45), (0.45, 0.2, 0.4), (0.35, 0.0, 0.35), (0.6, 0.1, 0.7)])
def test_depth_colour_and_mask_are_those_that_the_other_camera_has(position):
    camera = camera_at(*position)
    layer = warp(SOURCE, camera)
    depth, mask, rgb = cast(THING, camera)
    seen = layer.weight > 0
    off = np.abs(layer.depth_m - depth)[seen]
    assert seen.sum() > 5000 and np.median(off) < 1e-4 and np.quantile(off, 0.95) < 2e-3
    assert (layer.mask == mask)[seen].mean() > 0.98
    assert np.median(np.abs(layer.rgb.astype(int) - rgb)[seen]) <= 2


def test_a_nearer_camera_sees_no_gaps_on_a_surface():
    camera = camera_at(0.28, 0.06, 0.26)
    seen = warp(SOURCE, camera).weight > 0
    depth, _, _ = cast(THING, camera)
    faces = (depth > 0)[60:-60, 120:-120]
    assert seen[60:-60, 120:-120][faces].mean() > 0.75
    holes = ~seen[1:-1, 1:-1] & seen[:-2, 1:-1] & seen[2:, 1:-1] & seen[1:-1, :-2] & seen[1:-1, 2:]
    assert holes.sum() <= 3


def test_a_surface_seen_from_behind_hides_and_shows_nothing():
    layer = warp(SOURCE, camera_at(-0.5, 0.0, 0.3))
    behind = (layer.depth_m > 0) & (layer.weight == 0)
    assert behind.sum() > 200
    assert not layer.rgb[behind].any() or not layer.weight[behind].any()


def test_colours_follow_a_depth_camera_that_stands_elsewhere():
    color_camera = camera_at(0.5, 0.1, 0.45)
    depth_camera = Camera(K, frozen_array(color_camera.T_world_cam @ translation(0.02, 0.0, 0.0)))
    source = source_of(color_camera, depth_camera)
    expected = cast(THING, depth_camera)[2]
    seen = source.fitted.inverse > 0
    assert np.median(np.abs(source.rgb.astype(int) - expected)[seen]) <= 2


def test_depth_of_a_camera_that_moved_is_that_of_its_new_place():
    near, far = (
        camera_at(0.5, 0.1, 0.45),
        Camera(K, frozen_array(camera_at(0.5, 0.1, 0.45).T_world_cam @ translation(0.01, 0, 0))),
    )
    moved = move_depth(cast(THING, near)[0].astype(np.float32), near, far)
    truth = cast(THING, far)[0]
    both = (moved > 0) & (truth > 0)
    assert both.sum() > 0.9 * (truth > 0).sum() and np.quantile(np.abs(moved - truth)[both], 0.9) < 1e-4
    same = move_depth(cast(THING, near)[0].astype(np.float32), near, near)
    assert np.abs(same - cast(THING, near)[0])[same > 0].max() < 1e-5


def test_the_factor_scales_weights():
    camera = camera_at(0.45, 0.2, 0.4)
    assert np.allclose(warp(SOURCE, camera, 0.25).weight, 0.25 * warp(SOURCE, camera).weight)
