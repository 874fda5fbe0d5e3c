"""Lens distortion against OpenCV, which puts pixel centres on integers."""

import cv2
import numpy as np
import pytest

from schemas.job.views import Distortion
from schemas.scene.view import Intrinsics
from workers.geometry.distortion import distort, undistort

K = Intrinsics(width=640, height=480, fx=525.0, fy=520.0, cx=322.0, cy=239.0)
MATRIX = np.array([[525.0, 0, 321.5], [0, 520.0, 238.5], [0, 0, 1]])
LENSES = [
    Distortion(k1=-0.25, k2=0.06, p1=0.001, p2=-0.002, k3=0.01),
    Distortion(k1=0.1, k2=-0.2, p1=0.001, p2=0.0005, k3=0.1),
    Distortion(p1=0.01),
    Distortion(p2=0.01),
]


def coefficients(lens: Distortion) -> np.ndarray:
    return np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])


def grid() -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.linspace(0.5, 639.5, 33), np.linspace(0.5, 479.5, 25))
    return u.ravel(), v.ravel()


@pytest.mark.parametrize("lens", LENSES)
def test_points_are_drawn_where_opencv_draws_them(lens):
    u, v = grid()
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones_like(u)], axis=1)
    theirs, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), MATRIX, coefficients(lens))
    assert np.stack(distort(u, v, lens, K), axis=1) - 0.5 == pytest.approx(theirs[:, 0], abs=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_undoing_agrees_with_opencv_and_goes_round(lens):
    u, v = grid()
    ideal = undistort(u, v, lens, K)
    assert np.stack(distort(*ideal, lens, K)) == pytest.approx(np.stack([u, v]), abs=1e-6)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-13)
    points = np.stack([u, v], axis=1)[:, None] - 0.5
    theirs = cv2.undistortPoints(points, MATRIX, coefficients(lens), None, MATRIX, criteria=criteria)
    assert np.stack(ideal, axis=1) - 0.5 == pytest.approx(theirs[:, 0], abs=1e-4)


def test_what_a_lens_that_folds_over_never_draws_is_nan():
    """r (1 - r^2) is at most 0.385: farther out nothing is drawn."""
    lens = Distortion(k1=-1.0)
    u, _ = undistort(np.array([K.cx + 0.38 * K.fx, K.cx + 0.39 * K.fx]), np.array([K.cy, K.cy]), lens, K)
    assert np.isfinite(u[0])
    assert np.isnan(u[1])
