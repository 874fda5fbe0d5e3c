"""Rays: the box about what is visible, and pixels as the ray caster's own view has them."""

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
    made,
    scene_of,
    table_and,
    thing,
)

from services.study.images import Truth, truth_of
from tests.kit.shapes import box
from workers.geometry.raycast import cast_view


def test_the_patch_is_the_box_about_what_is_seen_of_the_object():
    """And not about its foot, which the top hides, nor about what another thing hides."""
    half = np.array([0.1, 0.075]) * F / TOP_Z
    patch = Truth(scene_of(table_and(block()))).patch(camera_above(), 0)
    expected = np.array([80 - half[0], 60 - half[1], 80 + half[0], 60 + half[1]])
    assert np.array(patch.box) * (WIDTH, HEIGHT, WIDTH, HEIGHT) == pytest.approx(expected, abs=0.3)
    roof = box(0.4, 0.4, 0.01, (0.2, 0.0, 0.205))  # its near edge is at the axis
    things = (thing(2, trimesh.util.concatenate([box(4, 4, 0.02, (0, 0, -0.01)), roof])), thing(3, block()))
    assert Truth(scene_of(things)).patch(camera_above(), 0).box[2] * WIDTH == pytest.approx(80.0, abs=0.3)


def test_rays_through_pixels_are_those_of_the_ray_caster_s_own_view():
    _, scene = made()
    camera = scene.pairs[0].mirror.camera
    depth_m, region, _ = cast_view(scene.posed.things, camera)
    pixels = truth_of(scene).pixels(camera)
    for seen in (pixels.box, pixels.spread):
        assert np.array_equal(seen.region, seen.of(region)) and seen.depth_m == pytest.approx(
            seen.of(depth_m), abs=1e-9
        )
    objects = np.count_nonzero(region >= 3)
    assert np.count_nonzero(pixels.box.region >= 3) == objects > 50
