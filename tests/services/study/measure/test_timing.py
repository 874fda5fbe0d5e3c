"""Costs: ratios to the job's own time in the same rounds, with new shapes counted alike for all."""

import pytest

from services.study.measure.timing import cost_of, job_cost

OWN = "the job"


def lap(scale: float = 1.0) -> dict[int, dict]:
    """Two scenes of 100 and 300 ms, of which new shapes are 20 and 60 more; everything `scale` times as slow."""
    return {
        scene: {
            "cold": scale * 1.2 * base,
            "whole": {OWN: scale * base, "tier=flat": scale * 0.5 * base},
            "settling": {OWN: scale * 0.02, "step=60": scale * 0.01},
            "bytes": {OWN: 1000, "tier=flat": 400},
        }
        for scene, base in ((0, 0.1), (1, 0.3))
    }


def test_the_job_costs_what_it_takes_with_shapes_that_are_new():
    ms, kilobytes = job_cost([lap()], OWN)
    assert ms == pytest.approx(1e3 * 1.2 * 0.2) and kilobytes == 1.0


def test_a_ratio_counts_new_shapes_in_both():
    cost = cost_of("tier=flat", OWN, [lap()])
    assert cost is not None
    assert cost.ratio.median == pytest.approx((0.48 - 0.2) / 0.48)
    assert cost.kilobytes == 0.4 and cost.scenes == 2


def test_what_only_settles_is_added_to_the_whole():
    cost = cost_of("step=60", OWN, [lap()])
    assert cost is not None
    assert cost.ratio.median == pytest.approx((0.48 - 0.02) / 0.48)
    assert cost.kilobytes is None


def test_a_machine_that_is_slower_in_one_round_changes_no_ratio_but_for_what_new_shapes_cost_once():
    alike = lap()
    for scene in alike.values():
        scene["cold"] = scene["whole"][OWN]
    slow = {k: {**one, "whole": {n: 3 * s for n, s in one["whole"].items()}} for k, one in alike.items()}
    cost = cost_of("tier=flat", OWN, [alike, slow])
    assert cost is not None
    assert cost.ratio.least == pytest.approx(0.5) and cost.ratio.most == pytest.approx(0.5)


def test_scenes_that_a_setting_cannot_make_count_in_neither():
    missing = lap()
    del missing[1]["whole"]["tier=flat"]
    cost = cost_of("tier=flat", OWN, [missing])
    assert cost is not None and cost.scenes == 1
    assert cost.ratio.median == pytest.approx((0.12 - 0.05) / 0.12)
    assert cost_of("never made", OWN, [lap()]) is None
