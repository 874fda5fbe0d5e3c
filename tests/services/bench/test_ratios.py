"""The arithmetic of a benchmark, on times that were made up."""

from statistics import fmean

import pytest

from services.bench.figures import Lap, Spread, by_processor, growth, idle_share, slope_ratio, stage_table, with_loading


def test_the_ratio_is_of_slopes_and_by_pairs():
    slow = [Lap(10, 20.0, 9.0, {}, 5.0), Lap(10, 30.0, 8.0, {}, 5.0), Lap(5, 5.0, 2.0, {}, 5.0)]
    fast = [Lap(10, 4.0, 3.0, {}), Lap(10, 5.0, 2.0, {}), Lap(10, 5.0, 2.0, {})]
    assert slope_ratio(slow, fast) == Spread(5.0, 2.0, 6.0)
    assert slope_ratio(slow, fast, by_processor) == Spread(3.0, 2.0, 4.0)
    assert slope_ratio(slow, fast, with_loading) == Spread(6.25, 4.0, 7.0)


def test_a_round_without_its_partner_is_refused():
    with pytest.raises(ValueError, match="shorter"):
        slope_ratio([Lap(1, 1.0, 1.0, {})], [])


def test_stages_are_per_scene_and_what_is_left_is_shown():
    laps = [Lap(2, 1.0, 1.0, {"render": 0.5, "write": 0.25}), Lap(4, 2.0, 2.0, {"render": 1.0})]
    assert stage_table(laps) == {"render": 250.0, "write": 62.5, "rest": 187.5}
    assert stage_table([*laps, Lap(1, 1.0, 1.0, {"rays": 0.75})], fmean)["rays"] == 250.0


def test_idle_share_is_what_no_shard_used():
    assert idle_share(19.0, 2, 10.0) == pytest.approx(0.05)


def test_growth_compares_the_end_with_the_beginning():
    assert growth([100.0] * 10 + [200.0] * 80 + [105.0] * 10, 10) == pytest.approx(0.05)
    assert growth([7.0], 1) == 0.0
