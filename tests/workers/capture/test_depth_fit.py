"""Planes fitted to depth, held against planes in closed form."""

import numpy as np
import pytest

from schemas.scene.view import Intrinsics
from workers.capture.surface.tsdf import fit_depth

K = Intrinsics(width=120, height=90, fx=912.0, fy=905.0, cx=61.0, cy=44.0)
"""A window of a Kinect's picture, where samples are two pixels apart."""


def plane_depth(normal, distance_m):
    """z of the plane normal . p = distance at every pixel's centre; and the cosine of incidence times the ray's length."""
    rows, columns = np.mgrid[0 : K.height, 0 : K.width]
    rays = np.stack([(columns + 0.5 - K.cx) / K.fx, (rows + 0.5 - K.cy) / K.fy, np.ones(rows.shape)], axis=-1)
    along = rays @ (np.array(normal) / np.linalg.norm(normal))
    return distance_m / along, along, rays


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.5, 0, 1), (0.3, -0.9, 1), (-1.2, 0.4, 1)])
def test_a_plane_is_fitted_exactly_with_its_angle(normal):
    depth, along, _ = plane_depth(normal, 0.6)
    fitted = fit_depth(depth.astype(np.float32), K, 80.0)
    inner = np.s_[10:-10, 10:-10]
    assert np.abs(1.0 / fitted.inverse[inner] - depth[inner]).max() < 2e-6
    assert np.abs(fitted.facing[inner] - along[inner]).max() < 2e-3


def test_a_window_is_the_same_part_of_the_whole():
    depth, _, _ = plane_depth((0.3, 0.2, 1), 0.7)
    whole, part = (fit_depth(depth.astype(np.float32), K, 75.0, window) for window in (None, (20, 30, 60, 80)))
    assert (part.top, part.left, part.inverse.shape) == (20, 30, (40, 50))
    assert np.array_equal(part.inverse, whole.inverse[20:60, 30:80])


def test_a_surface_at_a_larger_angle_is_left_out():
    depth, along, rays = plane_depth((1.2, 0, 1), 0.5)
    angle = np.degrees(np.arccos(along / np.linalg.norm(rays, axis=-1)))[45, 60]
    assert not fit_depth(depth.astype(np.float32), K, angle - 1.5).inverse[20:-20, 55:65].any()
    assert fit_depth(depth.astype(np.float32), K, angle + 1.5).inverse[20:-20, 55:65].all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_falls_by_the_root_of_the_samples(seed):
    depth, _, _ = plane_depth((0.2, 0.1, 1), 0.8)
    measured = (depth + np.random.default_rng(seed).normal(0, 0.001, depth.shape)).astype(np.float32)
    fitted = fit_depth(measured, K, 75.0)
    inner = np.s_[10:-10, 10:-10]
    error = 1.0 / fitted.inverse[inner] - depth[inner]
    assert 0.8 / 5 < error.std() / 0.001 < 1.2 / 5
    assert abs(error.mean()) < 5e-5


def test_pixels_along_an_edge_and_between_two_surfaces_are_left_out():
    depth = np.full((K.height, K.width), 0.8, np.float32)
    depth[:, :60] = 0.6
    depth[:, 60] = np.linspace(0.63, 0.77, K.height)  # flying pixels
    fitted = fit_depth(depth, K, 75.0)
    assert not fitted.inverse[:, 60].any()
    assert fitted.inverse[5:-5, 5:56].all() and fitted.inverse[5:-5, 65:-5].all()
    assert np.allclose(1.0 / fitted.inverse[5:-5, 5:58][fitted.inverse[5:-5, 5:58] > 0], 0.6, atol=1e-6)


def test_missing_depth_stays_missing_and_a_lone_speck_goes():
    depth = np.zeros((K.height, K.width), np.float32)
    depth[40:42, 50:52] = 0.7
    assert not fit_depth(depth, K, 75.0).inverse.any()
