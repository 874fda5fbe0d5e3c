"""From answers of single scenes to figures, verdicts and rows whose values are known; and which scenes a race asks for next."""

import math

import numpy as np
import pytest

from services.study.choose import LEAST, next_round, roughly_timed, standings, undecided
from services.study.model import OWN, REFERENCES, Figure, Setting
from services.study.table import (
    LEAST_OUTCOMES,
    Table,
    apart,
    bounds_of_percentile,
    figure_over_scenes,
    figures_of,
    share,
    split_settings,
    unit_name,
)

STEP = Setting((("step", "60"),), {"physics.step_hz": 60})
FLAT = Setting((("colour", "flat"),), {"render.tier": "flat"})
FAST = Setting((("preset", "fast"),), {"physics.step_hz": 60, "render.tier": "flat"})
UNITS = Setting((("units", "1000"),), {"images.depth_units_per_m": 1000})
PARTS = split_settings((OWN, STEP, FLAT, UNITS, FAST), captured=False)


def test_an_error_is_the_95th_percentile_of_the_scenes_and_lies_in_its_interval():
    figure = figure_over_scenes([float(k) for k in range(101)])
    assert (figure.value, figure.scenes) == (95.0, 101)
    assert 85.0 < figure.low < 95.0 < figure.high <= 100.0


@pytest.mark.parametrize("count", [4, 6, 16, 58, 59, 200])
@pytest.mark.parametrize(
    ("draw", "truth", "least"),
    [
        (lambda rng, size: np.exp(0.7 * rng.normal(size=size)), math.exp(0.7 * 1.6448536), 0.95),  # exact
        (lambda rng, size: rng.uniform(1.0, 2.0, size), 1.95, 0.95),
        (lambda rng, size: rng.exponential(size=size), math.log(20.0), 0.95),
        (lambda rng, size: rng.normal(5.0, 1.0, size=size), 5.0 + 1.6448536, 0.85),  # a tail that the logarithm cuts
    ],
    ids=["lognormal", "uniform", "exponential", "normal"],
)
def test_the_bound_of_few_scenes_covers_the_percentile_of_all_and_the_bootstrap_does_not(count, draw, truth, least):
    """Covered shares of 2,000 samples, where the true percentile is known by its formula; 0.017 are 3.5 standard errors."""
    rng = np.random.default_rng(count)
    samples = draw(rng, (2000, count))
    assert np.mean([bounds_of_percentile(one)[1] >= truth for one in samples]) >= least - 0.017
    assert np.mean([bounds_of_percentile(one)[0] <= truth for one in samples]) >= 0.95 - 0.017
    if count <= 16:
        assert np.mean([figure_over_scenes(one).high >= truth for one in samples[:200]]) < 0.7


def test_the_bound_of_scenes_that_are_alike_or_single_or_nothing():
    assert bounds_of_percentile(np.full(6, 0.3))[1] == pytest.approx(0.3, abs=1e-12)
    assert bounds_of_percentile(np.array([0.0, 1e-9, 0.0]), 0.02)[1] == pytest.approx(0.02, abs=1e-12)
    assert bounds_of_percentile(np.array([0.3]))[1] == math.inf
    assert figure_over_scenes([0.3]).most == math.inf and figure_over_scenes([0.0] * 60).most == 0.0
    assert share([0.0] * 6, [8.0] * 6, counted=True).most == pytest.approx(1.0 - 0.05 ** (1 / 48))  # none of 48
    assert share([0.0] * 6, [8.0] * 6).most == 0.0  # seconds are not counted
    assert figure_over_scenes([0.01, 0.9, 0.4], most=1.0).most == 1.0


def test_the_distance_of_two_distributions_is_their_shift():
    """Of samples that are shifted the first Wasserstein distance is the shift, and their order does not matter."""
    rng = np.random.default_rng(1)
    sample = rng.normal(size=300)
    figures = apart(sample + 0.7, sample)
    assert figures.value == pytest.approx(0.7, abs=1e-12)
    assert figures.low <= 0.7 + 1e-12 and figures.high >= 0.7 - 1e-12
    assert apart(sample, rng.permutation(sample)).value == pytest.approx(0.0, abs=1e-12)


def test_the_interval_of_a_share_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(2)
    figures = [share(list(rng.random(200) < 0.3), [1.0] * 200) for _ in range(100)]
    assert 88 <= sum(figure.low <= 0.3 <= figure.high for figure in figures) <= 100


def test_a_percentile_is_sure_by_the_count_of_scenes_above_the_target():
    """0.95^59 < 0.05 <= 0.95^58; with one above, 93 scenes (Conover). Half of the scenes have no error, so that the tail of a
    lognormal, by which fewer scenes are bounded, reaches beyond the target."""
    cases = {(0, 58): "open", (0, 59): "meets", (1, 59): "open", (1, 93): "meets", (2, 4): "misses", (1, 4): "open"}
    for (above, count), expected in (cases | {(30, 200): "misses"}).items():
        values = [2.0] * above + [0.9, 1e-9] * count
        assert figure_over_scenes(values[:count]).verdict(1.0) == expected
    assert Figure(0.3, 0.2, 0.4, 0.2, 0.4, 9).verdict(0.1) == "misses"  # of what is pooled by its interval


def rest(s: float, slid: float = 1.0, corner: float = 0.0, **more: object) -> dict:
    errors = {"penetration_mm": 0.1, "slid_mm": slid, "rolled_deg": 1.0}
    answer = {"s": s, "took": s, "errors": errors, "corners": [[[corner, 0, 0]]], "lost": 0, "planned": 2}
    return answer | more


def lost(s: float, reason: str = "left_table") -> dict:
    return {"s": s, "took": s, "failed": reason, "lost": 2, "planned": 2}


def test_rest_is_held_against_the_references_of_the_same_scenes():
    fine, finest = (
        {0: rest(1, 1.0), 1: rest(1, 2.0), 3: rest(1, 5.0)},
        {0: rest(1, corner=0.01), 1: rest(1, corner=9.0)},
    )
    own = {0: rest(1, 3.0, corner=2.0), 1: rest(1, 4.0), 2: rest(1, 100.0), 3: lost(1)}
    assert "outcome_mm" not in figures_of("rest", own, [fine, finest])  # two scenes tell nothing of a distribution
    more = range(4, 2 + LEAST_OUTCOMES)
    fine, own = fine | {n: rest(1, 2.0) for n in more}, own | {n: rest(1, 4.0) for n in more}
    figures = figures_of("rest", own, [fine, finest])
    assert figures["outcome_mm"].value == pytest.approx(2.0) and figures["outcome_mm"].scenes == LEAST_OUTCOMES
    assert figures["outcome_deg"].value == 0.0
    pose = figures["pose_mm"]  # of the scene in which the references agree
    assert (pose.value, pose.scenes) == (2.0, 1)
    assert figures["failed_share"].value == 1 / len(own) and figures["lost_share"].value == 1 / len(own)
    assert figures_of("rest", {}, [fine, finest]) == {}


def journal(scenes: int = 4, step_s: float = 0.5, flat_s: float = 0.5) -> dict[str, dict]:
    """The job takes 1 s to rest, 1 s to draw and 2 s for its plan."""
    figures = {}
    for n in range(scenes):
        figures[unit_name("rest", n, OWN)] = rest(1.0, plan_s=2.0)
        figures[unit_name("rest", n, STEP)] = rest(step_s)
        for one, s, size in ((OWN, 1.0, 1000), (FLAT, flat_s, 400), (UNITS, 1.0, 900)):
            drawn = {"depth_mm": 0.5 if one == UNITS else 0.1}
            figures[unit_name("draw", n, one)] = {"s": s, "took": s, "bytes": size, "errors": drawn}
        figures[unit_name("colour", n, FLAT)] = {"s": None, "took": 1.0, "errors": {"flip": 0.5}}
        figures[unit_name("colour", n, OWN)] = {"s": None, "took": 1.0, "errors": {"flip": 0.1}}
    return figures


def test_times_of_parts_add_up_and_a_preset_is_put_together_of_parts_that_were_measured_once():
    table = Table(PARTS, journal())
    own, step, flat, fast = (table.row(one) for one in (OWN, STEP, FLAT, FAST))
    assert (own.ms, own.ratio, own.kilobytes) == (4000.0, 1.0, 1.0)
    assert set(own.errors) >= {"penetration_mm", "depth_mm", "flip", "failed_share"}
    assert (step.ratio, step.ms, step.kilobytes) == (pytest.approx(3.5 / 4), pytest.approx(3500.0), 1.0)
    assert "depth_mm" not in step.errors and "penetration_mm" not in flat.errors
    assert (flat.ratio, flat.kilobytes, flat.errors["flip"].value) == (pytest.approx(3.5 / 4), 0.4, 0.5)
    assert fast.ratio == pytest.approx(3.0 / 4) and {"penetration_mm", "depth_mm", "flip"} <= set(fast.errors)
    once = Table(PARTS, journal(1)).row(STEP)  # one scene says nothing of others
    assert (once.ratio, once.ratio_least, once.ratio_most) == (pytest.approx(3.5 / 4), -math.inf, math.inf)
    assert PARTS.of[FAST.name]["rest"] == STEP and len(PARTS.measured["rest"]) == 2 + len(REFERENCES)


def test_percentiles_of_fewer_scenes_are_as_many_times_the_jobs_as_in_the_same_scenes():
    """The job's error is 1 mm in two scenes and 3 mm in two more, in which only it was measured; the setting's is half."""

    answers = {}
    for n in range(4):
        for some, depth_mm in ((OWN, 1.0 if n < 2 else 3.0), *([(UNITS, 0.5), (FLAT, 2.0)] if n < 2 else ())):
            errors = {"depth_mm": depth_mm, "mirror_mm": 1e-9 * depth_mm, "mask_share": min(1.0, depth_mm / 3.0)}
            answers[unit_name("draw", n, some)] = {"s": 1.0, "took": 1.0, "errors": errors}
    table = Table(PARTS, answers)
    flat = table.figures("draw", FLAT)["mask_share"]  # twice the job's, which is 1 in two more
    assert (flat.value, flat.high, flat.most) == (1.0, 1.0, 1.0)
    own, units = (table.figures("draw", one) for one in (OWN, UNITS))
    assert own["depth_mm"].value == pytest.approx(3.0)
    assert (units["depth_mm"].value, units["depth_mm"].scenes) == (pytest.approx(1.5), 2)
    assert units["mirror_mm"].value == pytest.approx(0.5e-9)  # of what is negligible a ratio is noise


def test_a_scene_that_fails_counts_and_a_setting_without_a_time_has_no_row():
    some = journal() | {
        unit_name("rest", 1, STEP): lost(0.1),
        unit_name("rest", 2, STEP): {**lost(0.1, "broken"), "broken": "flat"},
    }
    row = Table(PARTS, some).row(STEP)
    assert row.failed_share == 0.5 and row.notes == ("flat: 1 scene", "left_table: 1 scene")
    assert row.errors["lost_share"].value == 0.5
    del some[unit_name("draw", 0, FLAT)]
    assert Table(PARTS, some).row(FLAT).ratio == pytest.approx(3.5 / 4)
    assert Table(PARTS, {k: v for k, v in some.items() if not k.endswith(FLAT.name)}).row(FLAT) is None
    slept = {**rest(0.0), "s": None}
    assert Table(PARTS, some | {unit_name("rest", n, STEP): slept for n in range(4)}).row(STEP) is None


LOOSE = {"depth_mm": 0.2}


def test_every_round_asks_for_the_same_scenes_of_all_that_can_still_win():
    early, late = (Table(PARTS, journal(scenes)) for scenes in (2, LEAST))
    wanted = [(item.scene_id, item.setting.name) for item in next_round(early, "draw", LOOSE, range(4), 1e9)]
    assert sorted(wanted) == sorted((n, some.name) for n in (2, 3) for some in (OWN, FLAT, UNITS))
    assert next_round(early, "draw", LOOSE, range(2), 1e9) == []
    wanted = next_round(late, "draw", LOOSE, range(64), 1e9)
    assert {item.setting.name for item in wanted} == {OWN.name, FLAT.name} and len(wanted) == 2 * (64 - LEAST)


def left(answers: dict) -> set[str]:
    return {some.setting.name for some in standings(Table(PARTS, answers), "draw", LOOSE)}


def test_what_surely_misses_or_surely_costs_more_is_out_and_nothing_before_it_was_measured_enough():
    assert left(journal(LEAST - 1)) == {OWN.name, FLAT.name, UNITS.name}
    assert left(journal(LEAST)) == {OWN.name, FLAT.name}  # units miss the target
    assert left(journal(64, flat_s=3.0)) == {OWN.name}
    assert undecided(Table(PARTS, journal(64, flat_s=3.0)), "draw", LOOSE) == []
    spread = journal(16)
    for n in range(16):
        spread[unit_name("draw", n, FLAT)]["errors"] = {"depth_mm": 0.19 if n % 2 else 0.05}
    assert undecided(Table(PARTS, spread), "draw", LOOSE) == [FLAT]
    assert undecided(Table(PARTS, spread), "draw", {"pose_mm": 0.1}) == []  # what the job has not is not waited for


def test_the_job_is_measured_until_it_surely_meets_a_target_and_what_may_save_time_until_its_time_is_known():
    even, uneven, slower = journal(64), journal(16), journal(64, flat_s=1.0)
    for n in range(16):
        uneven[unit_name("draw", n, FLAT)]["s"] = 0.05 if n % 4 else 3.5
    assert roughly_timed(Table(PARTS, even), "draw", LOOSE) == []
    assert roughly_timed(Table(PARTS, uneven), "draw", LOOSE) == [FLAT]
    for n in range(64):
        even[unit_name("draw", n, OWN)]["errors"] = {"depth_mm": 0.25 if n == 7 else 0.1}
        slower[unit_name("draw", n, OWN)]["errors"] = {"depth_mm": 0.25 if n in (7, 9) else 0.15}
    assert OWN in undecided(Table(PARTS, slower), "draw", LOOSE)  # nothing saves time
    assert OWN not in undecided(Table(PARTS, even), "draw", LOOSE)  # whether it meets them or not, another is cheaper


def test_a_round_that_does_not_fit_keeps_the_promising_half_and_never_takes_more_than_allowed():
    """Eight settings of 1 s, of which those with a lower number are cheaper; the error of the last is above the target."""
    some = [Setting((("png_level", str(n)),), {"images.png_level": n}) for n in range(8)]
    parts = split_settings((OWN, *some), captured=False)
    answers: dict[str, dict] = {}
    for n in range(2):
        answers |= {unit_name("rest", n, OWN): rest(1.0)}
        for place, one in enumerate((OWN, *some)):
            drawn = {"depth_mm": 0.3 if one == some[-1] else 0.1}
            s = 1.0 if one == OWN else 0.5 + 0.05 * place
            answers[unit_name("draw", n, one)] = {"s": s, "took": 1.0, "bytes": 1, "errors": drawn}
    table = Table(parts, answers)

    def names(allowed_s: float) -> tuple[set[str], int]:
        wanted = next_round(table, "draw", LOOSE, range(6), allowed_s)
        assert len(wanted) <= 1.6 * allowed_s
        return {one.setting.name for one in wanted}, len({one.scene_id for one in wanted})

    assert names(36.0) == ({OWN.name, *(one.name for one in some)}, 4)
    assert names(35.0) == ({OWN.name, *(one.name for one in some[:3])}, 4)
    assert names(5.0) == ({OWN.name, *(one.name for one in some[:3])}, 2)
    assert names(0.0) == (set(), 0)


def test_references_are_measured_as_far_as_they_take_little():
    values = [Setting(((knob, str(n)),), {f"physics.{knob}": n}) for knob in ("a", "b") for n in (1, 2)]
    parts = split_settings((OWN, *values), captured=False)
    references = [reference.name for reference in REFERENCES]
    for took, is_in in ((1.0, True), (4.0, False)):
        answers = {unit_name("rest", n, setting): rest(1.0) for n in range(2) for setting in (OWN, *values)}
        answers |= {unit_name("rest", n, setting): rest(took) for n in range(2) for setting in REFERENCES}
        wanted = next_round(Table(parts, answers), "rest", {}, range(8), 1e9)
        assert (set(references) <= {item.setting.name for item in wanted}) == is_in
