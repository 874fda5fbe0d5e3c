"""Small holes are filled from the farther surface, outer edges stay."""

import numpy as np

from workers.capture.surface.synthesize import fill_holes


def scene():
    depth = np.full((60, 80), 1.0)
    depth[:, :40] = 0.8
    rgb = np.where(depth[..., None] < 0.9, [200, 10, 10], [10, 10, 200]).astype(np.uint8)
    return rgb, depth, depth < 0.9


def test_a_hole_within_a_surface_gets_its_depth_colour_and_mask():
    rgb, depth, mask = scene()
    depth[20:24, 10:14], rgb[20:24, 10:14], mask[20:24, 10:14] = 0.0, 0, False
    filled = fill_holes(rgb, depth, mask, 3)
    for got, expected in zip(filled, scene(), strict=True):
        assert np.allclose(got, expected)


def test_a_gap_between_two_surfaces_is_shared_and_its_middle_belongs_to_the_farther_one():
    rgb, depth, mask = scene()
    depth[:, 39:42], rgb[:, 39:42] = 0.0, 0
    for got, expected in zip(fill_holes(rgb, depth, mask, 3), scene(), strict=True):
        assert np.allclose(got[5:-5], expected[5:-5])


def test_an_enclosed_hole_is_filled_whole_or_not_at_all():
    rgb, depth, mask = scene()
    depth[10:21, 10:21], depth[35:50, 10:25] = 0.0, 0.0
    filled = fill_holes(rgb, depth, mask, 3)[1]
    assert np.allclose(filled[10:21, 10:21], 0.8)
    assert not filled[39:46, 14:21].any()


def test_large_holes_and_outer_edges_stay():
    rgb, depth, mask = scene()
    depth[:, 60:], depth[10:30, 10:30] = 0.0, 0.0
    filled = fill_holes(rgb, depth, mask, 3)[1]
    assert not filled[:, 60:].any()
    assert not filled[13:27, 13:27].any()
    assert np.array_equal(fill_holes(rgb, depth, mask, 0)[1], depth)


def test_what_was_given_is_not_changed():
    rgb, depth, mask = scene()
    depth[20:24, 10:14] = 0.0
    fill_holes(rgb, depth, mask, 3)
    assert not depth[20:24, 10:14].any()
