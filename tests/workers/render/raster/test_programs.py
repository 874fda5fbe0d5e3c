"""The projection and the lights that reach the GPU."""

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.shape import Appearance, Light
from schemas.scene.view import Intrinsics
from workers.geometry.camera import project
from workers.render.raster.draw_calls import NEAR_M, clip_from_cam, light_slots, place_lights


def test_clip_space_gives_the_cameras_image_coordinates():
    k = Intrinsics(width=641, height=333, fx=512.3, fy=498.7, cx=301.4, cy=177.9)
    points = np.random.default_rng(0).uniform([-2, -2, 0.1], [2, 2, 9], (50, 3))
    clip = np.column_stack([points, np.ones(50)]) @ clip_from_cam(k).T
    window = (clip[:, :2] / clip[:, 3:] + 1.0) / 2.0 * [k.width, k.height]
    np.testing.assert_allclose(window, np.stack(project(points, k), axis=1), rtol=1e-12)


def test_the_near_plane_cuts_and_nothing_is_cut_far_away():
    k = Intrinsics(width=4, height=4, fx=1.0, fy=1.0, cx=2.0, cy=2.0)
    for z, inside in ((NEAR_M * 0.999, False), (NEAR_M * 1.001, True), (1.0, True), (1e6, True)):
        clip = clip_from_cam(k) @ [0.0, 0.0, z, 1.0]
        assert (-clip[3] <= clip[2] <= clip[3]) == inside, z


def lit(count: int) -> Appearance:
    light = Light(frozen_array([0.0, 0.6, 0.8]), (0.5, 0.4, 0.3))
    return Appearance((0.1, 0.1, 0.1), (light,) * count, (0.0, 0.0, 0.0))


def test_lights_fill_the_slots_of_the_program_and_the_rest_is_dark():
    """The two lights of a scene of tier flat leave none dark, and tier raster has no programs for two."""
    slots = {raster: [light_slots(lit(count), raster) for count in range(7)] for raster in (False, True)}
    assert slots == {False: [1, 1, 2, 3, 6, 6, 6], True: [1, 1, 3, 3, 6, 6, 6]}
    placed = place_lights(lit(2), np.eye(4), raster=True)
    np.testing.assert_array_equal(placed.towards, np.float32([[0, 0.6, 0.8], [0, 0.6, 0.8], [0, 0, 0]]))
    np.testing.assert_array_equal(placed.color, np.float32([[0.5, 0.4, 0.3], [0.5, 0.4, 0.3], [0, 0, 0]]))


def test_seven_lights_are_too_many():
    with pytest.raises(ValueError, match="7 lights"):
        light_slots(lit(7), raster=False)
