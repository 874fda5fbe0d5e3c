import numpy as np
import pytest

from tests.workers.capture.photographs import KINECT, hand_held
from tests.workers.capture.poses.scenes import LENS, PINHOLE, project
from workers.capture.poses.observation import opencv_matrix, pixels_of_points, rays_of_pixels
from workers.geometry.frames import invert, transform


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_rays_and_pixels_are_inverse_and_agree_with_opencv(camera):
    rng = np.random.default_rng(0)
    T = hand_held(rng, 1)[0]
    points = np.column_stack([rng.uniform(-0.2, 0.2, (50, 2)), rng.uniform(0, 0.1, 50)])
    pixels = project(points, T, camera)
    assert pixels_of_points(points, T, camera) == pytest.approx(pixels, abs=1e-9)
    p = transform(invert(T), points)
    assert rays_of_pixels(pixels, camera) == pytest.approx(p[:, :2] / p[:, 2:], abs=1e-7)


def test_the_principal_point_moves_by_half_a_pixel_for_opencv():
    assert opencv_matrix(PINHOLE.intrinsics)[0, 2] == KINECT.cx - 0.5


def test_a_pixel_where_the_lens_model_folds_has_no_ray():
    strong = type(LENS)(KINECT, np.array([-0.6, 0, 0, 0, 0, 0, 0, 0]))
    rays = rays_of_pixels(np.array([[960.0, 540.0], [1.0, 1.0]]), strong)
    assert np.isfinite(rays[0]).all() and np.isnan(rays[1]).all()


def test_a_point_behind_the_camera_has_no_pixel():
    T = hand_held(np.random.default_rng(1), 1)[0]
    behind = T[:3, 3] - T[:3, 2]
    assert np.isnan(pixels_of_points(behind[None], T, PINHOLE)).all()
    assert rays_of_pixels(np.zeros((0, 2)), LENS).shape == (0, 2)
