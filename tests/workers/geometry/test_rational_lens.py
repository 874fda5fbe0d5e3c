"""The rational lens against OpenCV, which puts pixel centres on integers."""

import cv2
import numpy as np
import pytest

from tests.workers.geometry.made_up_kinect import COLOR, COLOR_LENS, DEPTH, DEPTH_LENS, opencv_rays, smaller
from workers.geometry.rational_lens import WIDEST, pixel_rays, project_points, usable_radius

PAIRS = [(smaller(COLOR, 0.1), COLOR_LENS), (smaller(DEPTH, 0.2), DEPTH_LENS)]


@pytest.mark.parametrize(("k", "lens"), PAIRS)
def test_points_are_drawn_where_opencv_draws_them(k, lens):
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 2.0], (500, 3))
    matrix = np.array([[k.fx, 0, k.cx_opencv], [0, k.fy, k.cy_opencv], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, np.asarray(lens))
    assert project_points(points, k, lens) - 0.5 == pytest.approx(theirs[:, 0], abs=1e-9)


@pytest.mark.parametrize(("k", "lens"), PAIRS)
def test_rays_of_pixels_are_opencvs(k, lens):
    assert pixel_rays(k, lens) == pytest.approx(opencv_rays(k, lens)[:, :, :2], abs=1e-9)


@pytest.mark.parametrize(("k", "lens"), PAIRS)
def test_the_ray_of_a_pixel_is_drawn_at_its_centre(k, lens):
    xy = pixel_rays(k, lens).reshape(-1, 2)
    u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    at = project_points(np.column_stack([xy, np.ones(len(xy))]) * 0.7, k, lens)
    assert at == pytest.approx(np.stack([u.ravel(), v.ravel()], axis=1), abs=1e-8)


def test_a_lens_is_used_up_to_its_fold_and_no_farther():
    lens = np.array([-0.3, 0, 0, 0, 0, 0, 0, 0])  # r (1 - 0.3 r2) rises up to r = 1 / sqrt(0.9)
    assert usable_radius(lens) == pytest.approx(1 / np.sqrt(0.9), abs=2e-3)
    assert usable_radius(np.zeros(8)) == WIDEST
    k = smaller(DEPTH, 0.2)
    inside, beyond = project_points(np.array([[1.0, 0, 1.0], [1.2, 0, 1.0]]), k, lens)
    assert np.isfinite(inside).all() and np.isnan(beyond).all()


def test_pixels_that_the_lens_does_not_reach_have_no_ray():
    k = smaller(DEPTH, 0.2)
    rays = pixel_rays(
        k, np.array([-0.6, 0, 0, 0, 0, 0, 0, 0])
    )  # the fold's image is at r = 0.497, the corner's at 0.87
    assert np.isnan(rays[0, 0]).all() and np.isfinite(rays[round(k.cy), round(k.cx)]).all()


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(project_points(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]), DEPTH, DEPTH_LENS)).all()
