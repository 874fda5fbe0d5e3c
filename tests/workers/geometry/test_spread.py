import numpy as np
import pytest

from workers.geometry.spread import spread_evenly


def test_all_are_taken_where_there_are_no_more():
    assert spread_evenly(3, 3).tolist() == [0, 1, 2]
    assert spread_evenly(2, 5).tolist() == [0, 1]
    assert spread_evenly(0, 5).tolist() == []


def test_of_more_the_first_and_the_last_are_taken_and_the_others_evenly_between():
    assert spread_evenly(10, 4).tolist() == [0, 3, 6, 9]
    assert spread_evenly(8, 3).tolist() == [0, 4, 7]
    assert spread_evenly(10, 1).tolist() == [0]


@pytest.mark.parametrize("most", [2, 3, 6, 40])
def test_as_many_as_asked_for_ascend_without_one_twice_and_gaps_differ_by_one_place_at_most(most: int):
    for count in range(most + 1, 200):
        gaps = np.diff(spread_evenly(count, most))
        assert len(gaps) == most - 1 and gaps.min() > 0 and np.ptp(gaps) <= 1
