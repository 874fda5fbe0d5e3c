"""Costs: ratios to the job's own time in the same rounds, with new shapes counted alike for all."""

import pytest

from services.study.measure import cost_of, job_cost, timed_rows
from services.study.model import Setting

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


def test_a_row_has_the_jobs_time_times_the_ratio_and_a_setting_without_a_time_has_none():
    flat, step, never = (Setting(((knob, value),)) for knob, value in (("tier", "flat"), ("step", "60"), ("step", "1")))
    (own, _), (second, scenes), (third, _) = timed_rows((Setting(), flat, step, never), [lap()])
    assert (own.setting, own.ms, own.ratio) == (Setting(), pytest.approx(240.0), 1.0)
    assert second.setting is flat and scenes == 2 and second.kilobytes == 0.4
    assert second.ms == pytest.approx(240.0 * second.ratio) and second.ratio_least == second.ratio == second.ratio_most
    assert third.setting is step and third.kilobytes == own.kilobytes == 1.0
    assert own.errors == {} and own.failed_share == 0.0


def test_scenes_that_a_setting_cannot_make_count_in_neither():
    missing = lap()
    del missing[1]["whole"]["tier=flat"]
    cost = cost_of("tier=flat", OWN, [missing])
    assert cost is not None and cost.scenes == 1
    assert cost.ratio.median == pytest.approx((0.12 - 0.05) / 0.12)
    assert cost_of("never made", OWN, [lap()]) is None
