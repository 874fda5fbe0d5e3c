"""Pairs of frames by their time stamps, and what is told of losses."""

import numpy as np
import pytest

from workers.capture.recording.choose import Losses, count_losses, describe_losses, pair_frames
from workers.capture.recording.tracks import Extent

PERIOD = 33_333.0
COLOR = (np.arange(10) * PERIOD).astype(np.int64)


@pytest.mark.parametrize("delay", [0.0, 160.0, -5_000.0, 12_000.0])
def test_each_frame_gets_its_own_depth_whatever_the_delay(delay):
    depth = (COLOR + delay).astype(np.int64)
    assert pair_frames(COLOR, depth, PERIOD, delay) == {i: i for i in range(10)}


def test_a_delay_that_is_not_told_moves_the_pairs_by_a_frame_at_most_half_a_period():
    assert pair_frames(COLOR, (COLOR + 0.4 * PERIOD).astype(np.int64), PERIOD) == {i: i for i in range(10)}
    later = pair_frames(COLOR, (COLOR + 0.6 * PERIOD).astype(np.int64), PERIOD)
    assert later == {i: i - 1 for i in range(1, 10)}


def test_a_colour_frame_whose_depth_is_missing_has_none():
    depth = np.delete(COLOR, [3, 4, 9])
    assert pair_frames(COLOR, depth, PERIOD) == {0: 0, 1: 1, 2: 2, 5: 3, 6: 4, 7: 5, 8: 6}
    assert pair_frames(COLOR, depth[:0], PERIOD) == {} and pair_frames(COLOR[:0], depth, PERIOD) == {}


def test_losses_are_counted_from_what_the_file_says():
    whole = Extent(1000, 10 * PERIOD)
    assert count_losses(COLOR, 10, 0, PERIOD, whole, 1000) == Losses(0, 0, 0, 0, False)
    assert count_losses(COLOR[:6], 6, 0, PERIOD, whole, 600) == Losses(0, 0, 0, 4, True)
    assert count_losses(COLOR[:6], 6, 0, PERIOD, Extent(1000), 600) == Losses(0, 0, 0, 4, True)
    assert count_losses(COLOR[:6], 5, 0, PERIOD, Extent(), 600) == Losses(0, 1, 0, None, True)
    assert count_losses(np.delete(COLOR, [2, 5]), 8, 1, PERIOD, whole, 1000) == Losses(1, 0, 1, 0, False)


def test_what_is_lost_is_told_in_numbers():
    assert describe_losses(Losses(0, 0, 0, 0, False)) == []
    told = "; ".join(describe_losses(Losses(3, 4, 5, 6, True)))
    assert all(word in told for word in ("about 6 frames", "3 frames are missing", "5 frames are damaged", "4 colour"))
    assert "nobody knows" in describe_losses(Losses(0, 0, 0, None, True))[0]
