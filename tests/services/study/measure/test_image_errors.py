"""Errors of depth and masks: stored images of scenes whose views have a closed form, off by a known amount."""

import numpy as np
import pytest
import trimesh
from tests.services.study.label_views import (
    HEIGHT,
    TABLE_Z,
    TOP_Z,
    UNITS,
    WIDTH,
    F,
    block,
    camera_above,
    made,
    measure,
    pair_of,
    seen_of_block,
    table_and,
    view,
)

from schemas.scene.view import Agreement, View
from services.study.images import measure_images, truth_of
from tests.effects.scenes import SMALL
from tests.kit.shapes import box


def test_views_that_are_as_the_formulas_say_have_no_error(seen):
    camera = camera_above()
    first = view("input", camera, *seen)
    mirror, projected = view("mirror", camera, *seen), view("projected", camera, seen[0], None)
    found = measure(
        table_and(block()), pair_of(first, mirror, projected=projected, agreement=Agreement(0.0, 1, 900, 0))
    )
    assert found.pop("outline_share") < 0.02  # the one that pixels bound: the outline runs through pixels
    assert found == pytest.approx(dict.fromkeys(found, 0.0), abs=1e-4)
    names = "depth_mm table_depth_mm mask_share between_mm mirror_mm agreement_mm unfilled_share hidden_share"
    assert set(found) == set(names.split())


def test_depth_off_by_seven_units_is_off_by_1_4_mm(seen):
    depth_m, region = seen
    first = view("input", camera_above(), depth_m + np.where(region == 3, 7 / UNITS, 0.0), region)
    found = measure(table_and(block()), pair_of(first))
    assert found["depth_mm"] == pytest.approx(1.4, abs=1e-3)
    assert found["between_mm"] == pytest.approx(1.4, abs=1e-3)
    assert found["table_depth_mm"] == pytest.approx(0.0, abs=1e-3)


def test_the_table_s_depth_is_told_apart_from_the_object_s(seen):
    depth_m, region = seen
    first = view("input", camera_above(), depth_m - np.where(region == 2, 11 / UNITS, 0.0), region)
    found = measure(table_and(block()), pair_of(first))
    assert found["depth_mm"] == pytest.approx(0.0, abs=1e-3)
    assert found["table_depth_mm"] == pytest.approx(2.2, abs=1e-3)


def test_the_coarser_unit_of_stored_depth_is_in_the_error():
    """1.8 m in units of 1/7 m is 12.6 and is stored as 13; the table's 14 is exact."""
    camera = camera_above()
    depth_m, region = seen_of_block(camera)
    first = View("input", 0, 0, camera, None, np.rint(depth_m * 7).astype(np.uint16), region, ())
    found = measure(table_and(block()), pair_of(first), units=7.0)
    assert found["depth_mm"] == pytest.approx((13 / 7 - 1.8) * 1e3)
    assert found["table_depth_mm"] == pytest.approx(0.0, abs=1e-6)


def test_depth_that_one_pixel_in_fifty_has_wrong_counts_and_one_in_two_hundred_does_not(seen):
    depth_m, region = seen
    rows, columns = np.nonzero(region == 3)
    for every, expected in ((50, 100.0), (200, 0.0)):
        wrong = depth_m.copy()
        wrong[rows[::every], columns[::every]] += 0.1
        found = measure(table_and(block()), pair_of(view("input", camera_above(), wrong, region)))
        assert found["depth_mm"] == pytest.approx(expected, abs=1e-3)


def test_pixels_without_depth_are_not_in_the_error_of_depth(seen):
    depth_m, region = (image.copy() for image in seen)
    depth_m[np.arange(HEIGHT) % 3 > 0] = 0.0
    found = measure(table_and(block()), pair_of(view("input", camera_above(), depth_m, region)))
    assert max(found["depth_mm"], found["table_depth_mm"], found["between_mm"]) == pytest.approx(0.0, abs=1e-3)


def test_a_mask_one_column_off_differs_by_two_columns_of_the_object_s(seen):
    depth_m, region = seen
    columns = np.count_nonzero(region == 3) / np.count_nonzero((region == 3).any(axis=1))
    moved = np.roll(region, 1, axis=1)
    found = measure(table_and(block()), pair_of(view("input", camera_above(), depth_m, moved)))
    assert found["mask_share"] == pytest.approx(2 / columns)


def seen_of_two_plates():
    """(things, depth, region): one object of two thin plates 0.2 m above the table, 20 pixels wide, with 40 between."""
    wide, middle = 20 * TOP_Z / F, 30 * TOP_Z / F
    plates = [box(wide, 0.15, 2e-4, (x, 0.0, 0.2 - 1e-4)) for x in (-middle, middle)]
    views = [seen_of_block(camera_above(), wide, 0.15, (x, 0.0)) for x in (-middle, middle)]
    depth_m, region = np.minimum(views[0][0], views[1][0]), np.maximum(views[0][1], views[1][1])
    return table_and(trimesh.util.concatenate(plates)), depth_m, region


def test_mask_pixels_between_an_object_s_parts_are_wrong():
    things, depth_m, region = seen_of_two_plates()
    assert measure(things, pair_of(view("input", camera_above(), depth_m, region)))["mask_share"] == 0.0
    filled = region.copy()
    filled[(region == 3).any(axis=1), 60:100] = 3
    found = measure(things, pair_of(view("input", camera_above(), depth_m, filled)))
    assert found["mask_share"] == pytest.approx(40 / 40)


def test_between_pixels_only_the_object_s_depth_counts():
    things, depth_m, region = seen_of_two_plates()
    off = depth_m + np.where(region == 2, 0.05, 0.0)
    found = measure(things, pair_of(view("input", camera_above(), off, region)))
    assert found["between_mm"] == pytest.approx(0.0, abs=1e-3)
    assert found["table_depth_mm"] == pytest.approx(50.0, abs=1e-3)


def test_mask_pixels_far_from_the_object_count_too(seen):
    depth_m, region = seen[0], seen[1].copy()
    region[:4, :5] = 3
    found = measure(table_and(block()), pair_of(view("input", camera_above(), depth_m, region)))
    assert found["mask_share"] == pytest.approx(20 / np.count_nonzero(seen[1] == 3))


def test_pixels_of_another_object_are_wrong(seen):
    depth_m, region = seen[0], seen[1].copy()
    mine = np.argwhere(region == 3)
    region[tuple(mine[:100].T)] = 4
    found = measure(table_and(block()), pair_of(view("input", camera_above(), depth_m, region)))
    assert found["mask_share"] == pytest.approx(100 / len(mine))


def test_pixels_of_all_views_and_pairs_count_together(seen):
    depth_m, region = seen
    right, wrong = view("input", camera_above(), *seen), region.copy()
    wrong[region == 3] = 2
    mirror = view("mirror", camera_above(), depth_m, wrong)
    aligned = view("aligned", camera_above(), depth_m, wrong)
    things = table_and(block())
    assert measure(things, pair_of(right, mirror))["mask_share"] == pytest.approx(1 / 2)
    assert measure(things, pair_of(right, aligned=aligned))["mask_share"] == pytest.approx(1 / 2)
    assert measure(things, pair_of(right, mirror), pair_of(right))["mask_share"] == pytest.approx(1 / 3)


def test_what_has_no_meaning_is_left_out():
    """No mirror view, no projection; and an object that nobody sees."""
    camera = camera_above()
    first = view("input", camera, *seen_of_block(camera))
    assert set(measure(table_and(block()), pair_of(first))) == {
        "depth_mm", "table_depth_mm", "mask_share", "between_mm", "outline_share"
    }  # fmt: skip
    nothing = view("input", camera, np.full((HEIGHT, WIDTH), TABLE_Z), np.full((HEIGHT, WIDTH), 2, np.uint8))
    away = table_and(block(at=(1.5, 0.0)))
    found = measure(
        away, pair_of(nothing, nothing, projected=view("projected", camera, np.zeros((HEIGHT, WIDTH)), None))
    )
    assert found == {"table_depth_mm": pytest.approx(0.0, abs=1e-6)}
    no_agreement = pair_of(first, first, agreement=Agreement(None, None, 3, None))
    assert "agreement_mm" not in measure(table_and(block()), no_agreement)


def test_a_made_scene_has_the_errors_that_its_units_and_pixels_leave():
    """99 of 100 of errors that rounding spreads evenly are within 99 % of half a unit. Pixels twice as wide, and nothing
    else changed, have twice the error between them, in as many more places along the outline."""
    fine, scene = made()
    truth = truth_of(scene)
    found = measure_images(fine, scene, truth)
    assert found["depth_mm"] == pytest.approx(0.99 * 0.1, abs=0.004)
    assert found["table_depth_mm"] == pytest.approx(0.99 * 0.1, abs=0.002)
    assert found["mask_share"] < 0.01
    coarse, rough = made(images={"depth_units_per_m": 500.0, "patch": SMALL["images"]["patch"]})
    again = measure_images(coarse, rough, truth_of(rough, truth))
    assert again["depth_mm"] == pytest.approx(0.99, abs=0.04)
    assert again["outline_share"] == found["outline_share"]
    k = {"width": 320, "height": 240, "fx": 262.5, "fy": 262.5, "cx": 160.0, "cy": 120.0}
    large, larger = made(cameras={"sensor": k})
    twice = measure_images(large, larger, truth_of(larger, truth))
    assert found["between_mm"] / twice["between_mm"] == pytest.approx(2.0, rel=0.25)
    assert found["outline_share"] / twice["outline_share"] == pytest.approx(2.0, rel=0.3)
    assert abs(found["mirror_mm"] - twice["mirror_mm"]) < found["mirror_mm"]
