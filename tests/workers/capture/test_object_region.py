"""Where the object stands, held against objects in closed form."""

import numpy as np
import pytest

from schemas.errors import CaptureError
from schemas.job.captures import Fusion
from tests.workers.capture.analytic_capture import BOARD, HIGH, RADIUS, SPHERE, Thing, capture
from workers.capture.surface.object_mask import CELL_M, find_object

FLAT = Thing(sphere=None, boxes=[(np.array([-0.04, -0.03, 0.0]), np.array([0.05, 0.03, 0.004]))])


@pytest.mark.parametrize("seed", [0, 1])
def test_the_region_holds_the_object_and_little_more(seed):
    region = find_object(capture(sigma_m=0.002, seed=seed), BOARD, Fusion())
    low, high = SPHERE[:2] - RADIUS, HIGH[:2]
    assert (region.low[:2] <= [low[0], min(low[1], -0.05)]).all() and (region.high[:2] >= high).all()
    assert (region.high[:2] - region.low[:2] < np.array([0.20, 0.12]) + 10 * CELL_M).all()
    assert 0.13 < region.high[2] < 0.20
    assert region.notes == ()
    assert np.abs(region.plane).max() < 5e-4


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_object_of_4_mm_is_found_in_depth_that_is_noisier(seed):
    region = find_object(capture(FLAT, sigma_m=0.004, seed=seed), BOARD, Fusion(board_clearance_m=0.002))
    grown = 4 * CELL_M
    assert (region.low[:2] < [-0.04, -0.03]).all() and (region.high[:2] > [0.05, 0.03]).all()
    assert (region.low[:2] > np.array([-0.04, -0.03]) - grown).all()
    assert (region.high[:2] < np.array([0.05, 0.03]) + grown).all()


def test_the_boards_plane_is_where_depth_has_it():
    views = capture(FLAT, sigma_m=0.001)
    for view in views:
        view.depth_m[view.depth_m > 0] += np.float32(0.008)  # along the axes, some 45 degrees from the vertical
    region = find_object(views, BOARD, Fusion(board_clearance_m=0.002))
    assert -0.009 < region.plane[2] < -0.004
    assert (region.low[:2] > [-0.07, -0.06]).all() and (region.high[:2] < [0.08, 0.06]).all()


def test_an_empty_board_and_an_object_below_the_clearance_are_refused_with_the_height():
    nothing = Thing(sphere=None, boxes=[])
    with pytest.raises(CaptureError, match="stands more than") as refusal:
        find_object(capture(nothing, sigma_m=0.002), BOARD, Fusion())
    assert refusal.value.reason == "no_object"
    with pytest.raises(CaptureError, match=r"6\.0 mm above it \(highest: [34]\.\d mm\): lower"):
        find_object(capture(FLAT), BOARD, Fusion(board_clearance_m=0.006))


def test_a_board_without_depth_is_refused():
    views = capture()
    for view in views:
        view.depth_m[:] = 0.0
    with pytest.raises(CaptureError, match="depth images are empty") as refusal:
        find_object(views, BOARD, Fusion())
    assert refusal.value.reason == "no_depth"


def test_the_largest_thing_is_the_object_and_the_others_are_told():
    pen = (np.array([0.15, 0.10, 0.0]), np.array([0.20, 0.15, 0.05]))
    thing = Thing(boxes=[*Thing().boxes, pen])
    region = find_object(capture(thing), BOARD, Fusion())
    assert region.high[0] < 0.12 and region.notes == ("1 other thing on the board left out",)
    points = np.array([[0.17, 0.12, 0.03], [0.0, 0.0, 0.05], [0.0, 0.0, 0.001], [5.0, 0.0, 0.05]])
    assert list(region.holds(points)) == [False, True, False, False]
