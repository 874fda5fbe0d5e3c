"""Errors between pixels: what the nearest pixel says of rays at random."""

import numpy as np
import pytest
import trimesh
from tests.services.study.label_views import (
    HEIGHT,
    TOP_Z,
    WIDTH,
    F,
    block,
    camera_above,
    measure,
    pair_of,
    seen_of_block,
    table_and,
    view,
)

from schemas.scene.view import View
from workers.geometry.frames import rotation_about


@pytest.mark.parametrize(("scale", "share"), [(1, 0.25), (2, 0.125)])
def test_between_pixels_of_a_slanted_face_depth_is_off_by_its_slope(scale, share):
    """A face turned by 30 degrees about the image's y axis; at the axis dz/du = tan(30) z / f, and the nearest pixel is a
    quarter of a pixel away in the median. The face is small, so that the slope is the same everywhere to 3 %."""
    camera = camera_above(WIDTH * scale, HEIGHT * scale, F * scale)
    k, angle = camera.intrinsics, np.pi / 6
    plate = trimesh.creation.box((0.12, 0.12, 0.002), rotation_4x4(np.array([0.0, 1.0, 0.0]), angle))
    plate.apply_translation((0.0, 0.0, 0.2))
    normal = np.array([np.sin(angle), 0.0, -np.cos(angle)])  # in the camera's frame, towards it
    on_face = np.array([0.0, 0.0, 1.8]) + 0.001 * normal
    u = (np.arange(k.width) + 0.5 - k.cx) / k.fx
    z = np.broadcast_to((normal @ on_face) / (normal[0] * u + normal[2]), (k.height, k.width))
    region = np.full(z.shape, 3, np.uint8)
    first = View("input", 0, 0, camera, None, np.rint(z * 30_000).astype(np.uint16), region, ())
    found = measure(table_and(plate), pair_of(first), units=30_000.0)
    expected_mm = share * np.tan(angle) * 1.8 / F * 1e3
    assert found["between_mm"] == pytest.approx(expected_mm, rel=0.06)


def rotation_4x4(axis, angle):
    T = np.eye(4)
    T[:3, :3] = rotation_about(axis, angle)
    return T


def test_rays_by_a_straight_outline_are_wrong_by_the_strip_that_no_pixel_s_centre_is_in():
    """A top from 52.2 to 107.8 across: pixels 52 to 107 have their centres in it, and no ray of its box crosses another. One
    from 52.6 to 107.4 has 0.4 on each side in pixels whose centres are not in it. Down it is from 39.7 to 80.3, and has 0.3."""
    camera = camera_above()
    for pixels, wrong in ((55.6, 0.0), (54.8, 0.8)):
        x, y = pixels * TOP_Z / F, 40.6 * TOP_Z / F
        first = view("input", camera, *seen_of_block(camera, x, y))
        found = measure(table_and(block(x, y)), pair_of(first))
        expected = 1 - (1 - wrong / pixels) * (1 - 0.6 / 40.6)
        assert found["outline_share"] == pytest.approx(expected, abs=4 * np.sqrt(expected / 4096))
