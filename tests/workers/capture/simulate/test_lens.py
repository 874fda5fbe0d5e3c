"""The lens: what is looked up where, against OpenCV's own projection."""

import cv2
import numpy as np
import pytest

from schemas.errors import CaptureError
from schemas.job.views import Distortion
from workers.capture.simulate.camera import add_bent_light, nearest_pixels, opencv_lens, pinhole_lookup
from workers.capture.simulate.photograph import make_rig

BARREL = Distortion(k1=-0.12, k2=0.05, p1=0.001, p2=-0.0007, k3=-0.01)
PINCUSHION = Distortion(k1=0.08, k2=-0.05, p1=0.0005, p2=-0.0004, k3=0.02)
K = make_rig(0.1).color


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
def test_opencv_projects_each_looked_up_ray_to_its_stored_pixel(lens):
    drawn, u, v = pinhole_lookup(lens, K)
    rays = np.stack([(u - drawn.cx) / drawn.fx, (v - drawn.cy) / drawn.fy, np.ones_like(u)], axis=-1).reshape(-1, 3)
    matrix = np.array([[K.fx, 0.0, K.cx_opencv], [0.0, K.fy, K.cy_opencv], [0.0, 0.0, 1.0]])
    seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, opencv_lens(lens))[0].reshape(*u.shape, 2)
    rows, columns = np.mgrid[0 : K.height, 0 : K.width]
    assert np.abs(seen - np.stack([columns, rows], axis=-1)).max() < 1e-6
    # All of it lies within the wider picture, with room for a sample beside a pixel's centre.
    assert u.min() > 1.0
    assert v.min() > 1.0
    assert u.max() < drawn.width - 1.0
    assert v.max() < drawn.height - 1.0


def test_a_ramp_is_read_at_the_samples_place():
    """Bilinear interpolation is exact on a ramp: light is a plane in the image, sampled with the lookup's own slope."""
    height, width = 6, 7
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    u, v = 2.3 + 1.1 * columns + 0.05 * rows, 2.6 + 0.9 * rows - 0.02 * columns
    ramp = np.repeat((np.arange(16)[None, :] * 3 + np.arange(16)[:, None] * 5)[..., None], 3, axis=2).astype(np.uint8)
    total = np.zeros((height, width, 3))
    right, down, drawn_right, drawn_down = 0.3, -0.2, -0.4, 0.1
    add_bent_light(total, ramp, np.arange(256.0), (u, v), (right, down, drawn_right, drawn_down))
    at_u, at_v = u + 1.1 * right + 0.05 * down, v + 0.9 * down - 0.02 * right
    expected = 3.0 * (at_u - drawn_right - 0.5) + 5.0 * (at_v - drawn_down - 0.5)
    assert np.allclose(total[..., 0], expected, atol=1e-9)
    assert np.array_equal(total[..., 0], total[..., 2])


def test_labels_are_those_of_the_pixel_that_is_hit():
    image = np.arange(12).reshape(3, 4)
    assert nearest_pixels(image, np.array([[1.0, 2.99]]), np.array([[0.2, 2.0]])).tolist() == [[1, 10]]


@pytest.mark.parametrize("lens", [Distortion(k1=-1.5), Distortion(k1=-0.45)])
def test_a_lens_that_no_camera_has_is_refused(lens):
    with pytest.raises(CaptureError, match="make its coefficients smaller"):
        pinhole_lookup(lens, K)


def test_no_lens_is_eight_zeros():
    assert opencv_lens(None).tolist() == [0.0] * 8
