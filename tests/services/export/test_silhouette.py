"""A square plate two metres ahead: its silhouette is known in closed form."""

import numpy as np
import pytest

from schemas.scene.shape import Part, Shape
from services.export.shapes import box_of, whole_silhouette

K = {"width": 160, "height": 120, "fx": 100.0, "fy": 100.0, "cx": 80.0, "cy": 60.0}
PLATE = np.array([[-0.4, -0.4, 0.0], [0.4, -0.4, 0.0], [0.4, 0.4, 0.0], [-0.4, 0.4, 0.0]])
SHAPE = Shape((Part("plate", PLATE, np.array([[0, 1, 2], [0, 2, 3]], np.int32)),))


def silhouette(x_m, visible, fraction, shape=SHAPE):
    T = np.eye(4)
    T[:3, 3] = x_m, 0.0, 2.0
    view = {**K, "T_world_cam": np.eye(4).ravel().tolist()}
    label = {"T_cam_obj": T.ravel().tolist(), "visible_fraction": fraction}
    return whole_silhouette(label, view, visible, shape)


def square(left, right):
    mask = np.zeros((120, 160), bool)
    mask[40:80, max(left, 0) : right] = True
    return mask


def test_what_is_hidden_is_found_by_rays():
    found = silhouette(0.001, square(60, 70), 0.25)
    np.testing.assert_array_equal(found.mask, square(60, 100))
    assert (found.pixels, found.box) == (1600, (60, 40, 40, 40))


@pytest.mark.parametrize(("x_m", "left", "right"), [(-1.599, -20, 20), (1.601, 140, 180), (-4.999, -190, -150)])
def test_what_lies_outside_the_image_is_counted(x_m, left, right):
    inside = square(left, min(right, 160)) if right > 0 else np.zeros((120, 160), bool)
    found = silhouette(x_m, inside, 0.5)
    np.testing.assert_array_equal(found.mask, inside)
    assert (found.pixels, found.box) == (1600, (left, 40, 40, 40))


def test_nothing_is_cast_where_all_is_seen_and_nothing_known_without_a_shape():
    found = silhouette(0.0, square(10, 30), 1.0, shape=None)
    assert (found.pixels, found.box) == (800, (10, 40, 20, 40))
    assert silhouette(0.0, square(60, 70), 0.25, shape=None) is None


def test_an_empty_mask_has_no_box():
    assert box_of(np.zeros((4, 4), bool)) == (-1, -1, -1, -1)
    mask = np.zeros((4, 4), bool)
    mask[1:3, 2] = True
    assert box_of(mask) == (2, 1, 1, 2)
