import cv2
import numpy as np

from workers.capture.board.detect import refine_corners
from workers.geometry.colour import encode_srgb


def square(corners, blur_px, exposure):
    """A dark square on white, 8 x 8 samples a pixel that lie within all four edges or not, pixel centres at integers."""
    x, y = np.meshgrid(*[np.arange(120 * 8) / 8 + 1 / 16 - 0.5] * 2)
    inside = np.ones_like(x, bool)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0
    white = 255.0 * (1 - inside.reshape(120, 8, 120, 8).mean((1, 3)))
    light = 0.02 + cv2.GaussianBlur(white / 255, (0, 0), blur_px) * exposure
    return np.rint(255 * encode_srgb(light)).astype(np.uint8)


def test_corners_of_a_drawn_square_are_found_to_a_few_hundredths_of_a_pixel():
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(10):
        true = np.array([[30, 28], [88, 34], [84, 90], [26, 86]]) + rng.uniform(-3, 3, (4, 2))
        start = true + rng.uniform(-1.5, 1.5, (4, 2))
        found = refine_corners(square(true, 0.8, 0.8), start[None], 6)[0]
        errors.append(found - true)
    errors = np.array(errors)
    assert np.abs(errors).max() < 0.06
    assert np.sqrt((errors**2).mean()) < 0.02


def test_a_picture_without_edges_leaves_the_corners():
    corners = np.array([[[30.0, 30], [80, 30], [80, 80], [30, 80]]])
    assert np.array_equal(refine_corners(np.full((120, 120), 99, np.uint8), corners, 6), corners)


def test_no_marker_gives_no_corner():
    assert refine_corners(np.zeros((9, 9), np.uint8), np.zeros((0, 4, 2)), 6).shape == (0, 4, 2)
