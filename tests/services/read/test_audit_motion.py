"""Motions and changed mask pixels, of boxes whose figures are known."""

import dataclasses

import numpy as np
import pytest

from schemas.scene.scene import Placed, PosedScene
from schemas.scene.view import Camera, Intrinsics, View
from services.read.audit import compare_masks, move_between, shift_px
from tests.kit.shapes import box, shape_of
from tests.workers.render.random_scenes import APPEARANCE, floor
from workers.geometry.frames import UP, pose, rotation_about, translation
from workers.render.raster.gbuffer import shared_renderer


def test_a_turn_and_a_shift_are_measured_exactly_however_small():
    shape = shape_of(box(0.2, 0.2, 0.2))
    turn = pose(rotation_about(UP, np.radians(1e-5)), np.zeros(3))
    motion = move_between(shape, np.eye(4), turn)
    assert motion.turned_deg == pytest.approx(1e-5, rel=1e-6)
    assert motion.moved_mm == pytest.approx(np.radians(1e-5) * 0.1 * np.sqrt(2) * 1e3, rel=1e-6)
    assert move_between(shape, turn, translation(0.0, 3e-5, 4e-5) @ turn).moved_mm == pytest.approx(0.05, rel=1e-6)


# A camera 1 m above a box of 20 cm; a pixel is 1 mm on its top, 0.9 m away.
LOOKS_DOWN = Camera(
    Intrinsics(width=320, height=240, fx=900.0, fy=900.0, cx=160.3, cy=120.2),
    pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0])),
)


def seen_box(x_m: float = 0.0) -> PosedScene:
    return PosedScene((floor(), Placed(3, shape_of(box(0.2, 0.2, 0.2)), translation(x_m, 0.0, 0.0))), APPEARANCE)


def view_of(scene: PosedScene) -> View:
    seen = shared_renderer().draw(scene.things, scene.appearance, LOOKS_DOWN)
    return View("input", 0, 0, LOOKS_DOWN, seen.rgb, seen.depth_m.astype(np.uint16), seen.region, ())


def test_the_rows_of_pixels_that_a_moved_box_uncovers_lie_within_its_motion():
    before, after = seen_box(), seen_box(0.0013)
    assert shift_px(before.things[1], after.things[1], LOOKS_DOWN) == pytest.approx(1.3, rel=1e-6)
    changed, outside = compare_masks(shared_renderer(), before, after, view_of(before))
    assert changed >= 2 * 200
    assert outside == 0


def test_a_mask_that_changed_where_no_silhouette_moved_is_counted():
    before = seen_box()
    view = view_of(before)
    assert view.region is not None
    region = view.region.copy()
    region[120, 150:157] = 1
    changed, outside = compare_masks(shared_renderer(), before, before, dataclasses.replace(view, region=region))
    assert (changed, outside) == (7, 7)
