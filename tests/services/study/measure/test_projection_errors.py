"""Errors of the projection: pixels left empty, and pixels that show hidden surfaces."""

import numpy as np
import pytest
from tests.services.study.label_views import (
    HEIGHT,
    TABLE_Z,
    WIDTH,
    block,
    camera_above,
    measure,
    pair_of,
    table_and,
    view,
)

from schemas.base import frozen_array
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.camera import look_at


def test_pixels_that_the_projection_leaves_empty_are_counted_on_the_object_alone(seen):
    depth_m, region = seen
    mine = np.argwhere(region == 3)
    depth = np.where(region == 3, depth_m, 0.0)
    depth[tuple(mine[::3].T)] = 0.0
    first = view("input", camera_above(), *seen)
    projected = view("projected", camera_above(), depth, None)
    found = measure(table_and(block()), pair_of(first, first, projected=projected))
    assert found["unfilled_share"] == pytest.approx(len(mine[::3]) / len(mine))


def oblique_views():
    """A camera on each side of a block, both 45 degrees up; each sees its top and one side. (things, input, mirror, whether
    the mirror's ray meets the top, by formula)."""
    k = Intrinsics(width=WIDTH, height=HEIGHT, fx=300.0, fy=300.0, cx=80.0, cy=60.0)
    left, right = (
        Camera(k, frozen_array(look_at(np.array([x, 0.0, 1.1]), np.array([0.0, 0.0, 0.1])))) for x in (-1, 1)
    )
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1) @ right.T_world_cam[:3, :3].T
    z = (0.2 - right.position[2]) / rays[..., 2]
    at = right.position + z[..., None] * rays
    return table_and(block()), left, right, (np.abs(at[..., 0]) < 0.1) & (np.abs(at[..., 1]) < 0.075)


def test_only_what_both_cameras_see_has_to_be_filled():
    things, left, right, top = oblique_views()
    empty = np.zeros((HEIGHT, WIDTH))
    region = np.full(empty.shape, 2, np.uint8)
    first, mirror = view("input", left, empty, region), view("mirror", right, empty, region)
    for filled, expected in ((top, 0.0), (~top, 1.0)):
        projected = view("projected", right, np.where(filled, 1.3, 0.0), None)
        found = measure(things, pair_of(first, mirror, projected=projected))
        assert found["unfilled_share"] == pytest.approx(expected, abs=2 / np.count_nonzero(top))


def test_a_projected_pixel_behind_the_surface_is_hidden_and_one_before_it_is_not(seen):
    _, region = seen
    drawn = np.where(region == 3, TABLE_Z, 0.0)  # the table, where the block hides it
    drawn[:5] = 1.0  # before the table
    drawn[5:7] = TABLE_Z + 0.004
    drawn[7:8] = TABLE_Z + 0.006
    first = view("input", camera_above(), *seen)
    found = measure(table_and(block()), pair_of(first, first, projected=view("projected", camera_above(), drawn, None)))
    block_pixels = np.count_nonzero(region == 3)
    assert found["hidden_share"] == pytest.approx((block_pixels + WIDTH) / (block_pixels + 8 * WIDTH))


def test_a_sample_of_a_large_image_tells_what_is_hidden_in_all_of_it():
    """Filled in a pattern of every second column, as a projection fills; every second of these is hidden."""
    camera = camera_above(640, 480, 2000.0)
    drawn = np.zeros((480, 640))
    drawn[:, ::4], drawn[:, 2::4] = TABLE_Z, TABLE_Z + 0.1
    first = view("input", camera, np.full(drawn.shape, TABLE_Z), np.full(drawn.shape, 2, np.uint8))
    found = measure(
        table_and(block(0.01, 0.01)), pair_of(first, first, projected=view("projected", camera, drawn, None))
    )
    assert found["hidden_share"] == pytest.approx(1 / 2, abs=4 * np.sqrt(0.25 / 9600))
