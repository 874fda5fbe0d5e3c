"""The views of a processed capture, against exact depth at the same cameras."""

import dataclasses

import numpy as np
import pytest

from schemas.capture import DepthCorrection
from tests.workers.pipeline.captures.small_capture import CAPTURES, made, processed, true_estimates
from workers.capture.folder import open_folder, read_view
from workers.capture.reconstruct import given_files
from workers.capture.score import read_whole_truth
from workers.capture.stored import read_result
from workers.capture.surface.evaluate import true_view
from workers.capture.views import CaptureViews
from workers.geometry.frames import half_turn, translation


@pytest.fixture(scope="module")
def result():
    return read_result(processed()[0])


def views_of(depth):
    estimate = dataclasses.replace(true_estimates(made()).estimate, depth=depth)
    return CaptureViews(given_files(open_folder(made())), estimate, CAPTURES, read_result(processed()[0]).views.body)


def test_a_captured_view_keeps_its_picture_and_its_depth_is_what_was_measured_and_corrected():
    depth = DepthCorrection(offset_m=-0.0015, scale=1 / 1.001)
    images, stored = views_of(depth).images(3), read_view(open_folder(made()), 3)
    assert np.array_equal(images.rgb, stored.rgb)
    expected = np.where(stored.depth > 0, stored.depth * 0.001 * depth.scale + depth.offset_m, 0)
    assert np.allclose(images.depth_m, expected, atol=1e-6)


def test_depth_and_mask_of_a_captured_view_are_near_the_truth(result):
    images = result.views.images(3)
    truth = true_view(read_whole_truth(result.folder).surface, images.camera)
    both = images.mask & (truth > 0) & (images.depth_m > 0)
    assert both.sum() > 0.8 * (truth > 0).sum()
    assert abs(np.median((images.depth_m - truth)[both])) < 0.001


def test_a_mirror_view_stands_on_the_other_side_and_shows_the_true_depth(result):
    for number in (0, 5):
        camera, d_z, view = result.views.mirror(number)
        T = result.estimate.views[number].T_board_cam
        pivot = T[:3, 3] + d_z * T[:3, 2]
        assert np.allclose(camera.position + 1.3 * camera.T_world_cam[:3, 2], pivot)
        assert np.allclose(camera.T_world_cam[:3, :3], half_turn(np.array([0.0, 0.0, 1.0])) @ T[:3, :3])
        truth = true_view(read_whole_truth(result.folder).surface, camera)
        both = view.mask & (truth > 0) & (view.depth_m > 0)
        assert both.sum() > 0.8 * (truth > 0).sum()
        assert np.median(np.abs(view.depth_m - truth)[both]) < 0.0015
        assert 0.8 < view.measured_share <= 1.0


def test_a_view_that_is_left_out_is_no_source(result):
    camera = result.views.posed(4).camera
    assert result.views.synthesize(camera).sources[0] == 4
    assert 4 not in result.views.synthesize(camera, without=4).sources


def test_depth_is_drawn_anew_where_the_correction_moves_the_depth_camera():
    straight = views_of(DepthCorrection()).images(0).depth_m
    moved = views_of(DepthCorrection(T_cam_depth=translation(0.02, 0.0, 0.0))).images(0).depth_m
    k = open_folder(made()).camera.intrinsics
    # 20 mm to the right is 20 mm * f / z pixels; depth stays, and the image of the board moves.
    z = np.median(straight[straight > 0])
    shift = round(0.02 * k.fx / float(z))
    assert shift > 5
    far = straight[:, : -shift - 1], moved[:, shift:-1]
    known = (far[0] > 0) & (far[1] > 0)
    still = (straight > 0) & (moved > 0)
    assert np.median(np.abs(far[0] - far[1])[known]) < 0.5 * np.median(np.abs(straight - moved)[still])
    assert (moved > 0).sum() > 0.8 * (straight > 0).sum()
