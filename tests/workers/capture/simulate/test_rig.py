"""The simulated device, against the published numbers."""

import math

import numpy as np
import pytest

from schemas.job.captures import RegistrationError
from workers.capture.simulate.photograph import COLOR, assumed_device, make_rig
from workers.geometry.frames import transform


def test_the_colour_camera_is_the_articles_in_both_pixel_conventions():
    k = make_rig(1.0).color
    assert (k.width, k.height, k.fx, k.fy) == (1920, 1080, 912.37, 912.25)
    assert (k.cx_opencv, k.cy_opencv) == pytest.approx((961.44, 548.29))
    assert (k.cx, k.cy) == pytest.approx((961.94, 548.79))


def test_the_depth_camera_stands_beside_and_looks_down_by_six_degrees():
    device = make_rig(1.0).depth
    assert (device.intrinsics.width, device.intrinsics.height) == (640, 576)
    T = device.T_color_depth
    assert np.linalg.norm(T[:3, 3]) == pytest.approx(0.0323, abs=1e-3)
    axis = T[:3, 2]
    assert axis[1] == pytest.approx(math.sin(math.radians(6.0)))  # y runs down
    assert axis[0] == 0.0


def test_a_smaller_image_sees_the_same():
    k = make_rig(0.25).color
    assert (k.width, k.height) == (480, 270)
    assert (0.0 - k.cx) / k.fx == pytest.approx((0.0 - COLOR.cx) / COLOR.fx)
    assert (270 - k.cy) / k.fy == pytest.approx((1080 - COLOR.cy) / COLOR.fy)


def test_a_wrong_calibration_takes_points_to_elsewhere():
    device = make_rig(1.0).depth
    assert assumed_device(device, None) is device
    point = np.array([[0.1, -0.2, 0.8]])
    true = transform(device.T_color_depth, point)
    shifted = assumed_device(device, RegistrationError(shift_m=[0.01, -0.002, 0.003]))
    assert np.allclose(transform(shifted.T_color_depth, point) - true, [0.01, -0.002, 0.003])
    turned = assumed_device(device, RegistrationError(shift_m=[0.0, 0.0, 0.0], turn_deg=1.0))
    moved = transform(turned.T_color_depth, point) - true
    assert np.linalg.norm(moved) == pytest.approx(math.radians(1.0) * np.hypot(true[0, 0], true[0, 2]), rel=1e-3)
    assert moved[0, 1] == 0.0  # about the image's vertical
