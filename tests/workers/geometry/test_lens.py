"""Lenses against OpenCV, which puts pixel centres on integers."""

import cv2
import numpy as np
import pytest

from schemas.job.views import Distortion
from schemas.scene.view import Intrinsics
from tests.workers.geometry.made_up_kinect import COLOR, COLOR_LENS, DEPTH, DEPTH_LENS, opencv_rays, smaller
from workers.geometry.pixels import (
    WIDEST,
    distort,
    opencv_lens,
    opencv_matrix,
    pixel_rays,
    project_points,
    undistort,
    usable_radius,
)

PAIRS = [(smaller(COLOR, 0.1), COLOR_LENS), (smaller(DEPTH, 0.2), DEPTH_LENS)]
K = Intrinsics(width=640, height=480, fx=525.0, fy=520.0, cx=322.0, cy=239.0)


def test_points_are_drawn_where_opencv_draws_them_and_rays_lead_back():
    for k, lens in PAIRS:
        points = np.random.default_rng(1).uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 2.0], (500, 3))
        theirs, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), opencv_matrix(k), np.asarray(lens))
        assert project_points(points, k, lens) - 0.5 == pytest.approx(theirs[:, 0], abs=1e-9)
        rays = pixel_rays(k, lens)
        assert rays == pytest.approx(opencv_rays(k, lens)[:, :, :2], abs=1e-9)
        u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
        at = project_points(np.column_stack([rays.reshape(-1, 2), np.ones(u.size)]) * 0.7, k, lens)
        assert at == pytest.approx(np.stack([u.ravel(), v.ravel()], axis=1), abs=1e-8)
    assert opencv_matrix(K)[0, 2] == K.cx - 0.5


def test_the_lens_of_a_scene_agrees_with_opencv_both_ways():
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0.5, 639.5, 33), np.linspace(0.5, 479.5, 25)))
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones_like(u)], axis=1)
    for lens in (
        Distortion(k1=-0.25, k2=0.06, p1=0.001, p2=-0.002, k3=0.01),
        Distortion(k1=0.1, k2=-0.2, p1=0.001, p2=0.0005, k3=0.1),
        Distortion(p1=0.01),
        Distortion(p2=0.01),
        Distortion(k1=0.5),
    ):
        theirs, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), opencv_matrix(K), opencv_lens(lens))
        assert np.stack(distort(u, v, lens, K), axis=1) - 0.5 == pytest.approx(theirs[:, 0], abs=1e-9)
        straight = undistort(u, v, lens, K)
        assert np.stack(distort(*straight, lens, K)) == pytest.approx(np.stack([u, v]), abs=1e-6)


def test_a_lens_is_used_up_to_its_fold_and_no_farther():
    lens = np.array([-0.3, 0, 0, 0, 0, 0, 0, 0])  # r (1 - 0.3 r2) rises up to r = 1 / sqrt(0.9)
    assert usable_radius(lens) == pytest.approx(1 / np.sqrt(0.9), abs=2e-3) and usable_radius(np.zeros(8)) == WIDEST
    inside, beyond, behind, within = project_points(
        np.array([[1.0, 0, 1.0], [1.2, 0, 1.0], [0, 0, -1.0], [0, 0, 0.0]]), K, lens
    )
    assert np.isfinite(inside).all() and np.isnan([beyond, behind, within]).all()


def test_pixels_that_the_lens_does_not_reach_have_no_ray_wherever_they_lie():
    """r (1 - r^2) is at most 0.385: farther out nothing is drawn, and the axis's other side is none of a pixel's rays."""
    folding = Distortion(k1=-1.0)
    v, u = np.mgrid[0 : K.height : 7, 0 : K.width : 7] + 0.5
    radius = np.hypot((u - K.cx) / K.fx, (v - K.cy) / K.fy)
    x, y = undistort(u, v, folding, K)
    assert np.isnan(x[radius > 0.386]).all() and np.isfinite(x[radius < 0.383]).all()
    found = radius < 0.383
    assert ((x - K.cx) * (u - K.cx) >= 0)[found].all() and ((y - K.cy) * (v - K.cy) >= 0)[found].all()
    rays = pixel_rays(smaller(DEPTH, 0.2), np.array([-0.6, 0, 0, 0, 0, 0, 0, 0]))
    assert np.isnan(rays[0, 0]).all() and np.isfinite(rays[68, 64]).all()
