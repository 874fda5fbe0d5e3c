"""Every effect on a scene that needs it and on one that does not: the plan, what leaving out breaks, what forcing changes."""

import importlib.util
from typing import Any

import pytest

from tests.effects.cases import ASKED, NO_OPS, Case
from tests.effects.physics_cases import PHYSICS
from tests.effects.scenes import Setting, facts_of, make
from workers.pipeline.make_scene import Stopwatch
from workers.pipeline.rows import timing_row
from workers.plan.effects import EFFECTS, names_of_kind, plan_effects, write_receipt

CASES: dict[str, Case] = {**PHYSICS, **ASKED, **NO_OPS}

CHECKS_ONLY = {"exact_agreement"}
"""No-ops whose work is no file but a figure that a scene is checked by."""


def test_every_effect_has_its_three_tests():
    """A new entry of the table needs a case, which every test below takes up."""
    assert {effect.name for effect in EFFECTS} == CASES.keys()
    assert names_of_kind("no_op") == NO_OPS.keys()
    assert names_of_kind("approximation") == PHYSICS.keys()
    assert names_of_kind("asked") == ASKED.keys()
    assert len(EFFECTS) == len({effect.name for effect in EFFECTS})
    assert all(effect.cost and effect.stage for effect in EFFECTS)


@pytest.mark.parametrize("name", CASES)
def test_the_plan_runs_it_where_the_scene_needs_it_and_says_why_not_elsewhere(name):
    needs, spares = plan_effects(facts_of(CASES[name].needs)), plan_effects(facts_of(CASES[name].spares))
    assert needs.runs(name) and name not in needs.skipped
    assert not spares.runs(name)
    assert spares.skipped[name] == CASES[name].why


@pytest.mark.parametrize("name", ASKED)
def test_a_switch_of_the_job_changes_what_is_stored(name):
    if name in ("global_illumination", "glass") and not importlib.util.find_spec("mitsuba"):
        pytest.skip("mitsuba is not installed: `./verso extra pathtraced`")
    needs, spares = make(ASKED[name].needs), make(ASKED[name].spares)
    assert (needs.files, needs.rows) != (spares.files, spares.rows)


@pytest.mark.parametrize("name", sorted(NO_OPS.keys() - CHECKS_ONLY))
def test_leaving_a_no_op_out_where_it_is_needed_changes_bytes(name):
    assert make(NO_OPS[name].needs).files != make(NO_OPS[name].needs, left_out=name).files


def test_without_the_exact_agreement_a_check_of_noisy_views_has_nothing_to_compare():
    """Depth noise of 7 mm from pixel to pixel is no smooth surface anywhere, and only smooth ones are compared."""
    needs = NO_OPS["exact_agreement"].needs
    exact, blind = (make(needs, left_out=name).scene.pairs[0].exact_agreement for name in (None, "exact_agreement"))
    assert exact.scene_median_mm is not None and exact.scene_median_mm < 0.1
    assert blind.scene_median_mm is None and blind.median_mm is None


@pytest.mark.parametrize("name", NO_OPS)
def test_forcing_a_no_op_where_nothing_calls_for_it_changes_no_byte(name):
    plain, forced = make(NO_OPS[name].spares), make(NO_OPS[name].spares, forced=name)
    assert plain.files == forced.files
    assert plain.rows == forced.rows
    assert not plain.scene.effects.runs(name)
    assert forced.scene.effects.runs(name)
    if name in CHECKS_ONLY:
        assert name in forced.watch.effects and name not in plain.watch.effects


@pytest.mark.parametrize(
    ("forced", "message"),
    [({"mirror"}, "cannot be forced: mirror"), ({"samples", "floor"}, "forced: samples"), ({"x"}, "names: x")],
)
def test_switches_and_unknown_names_cannot_be_forced(forced, message):
    with pytest.raises(ValueError, match=message):
        plan_effects(facts_of(Setting({})), frozenset(forced))


def test_an_effect_that_was_called_for_late_moves_from_skipped_to_ran():
    plan = plan_effects(facts_of(PHYSICS["table_mesh"].spares))
    ran, skipped = write_receipt(plan)
    assert "table_mesh" not in ran and "table_mesh" in {one["effect"] for one in skipped}
    ran, skipped = write_receipt(plan, {"table_mesh"})
    assert ran[:2] == ["dynamics", "table_mesh"]
    assert "table_mesh" not in {one["effect"] for one in skipped}
    assert {*ran, *(one["effect"] for one in skipped)} == {effect.name for effect in EFFECTS}


def test_every_effect_that_ran_is_timed_within_a_stage_that_was_timed():
    made = make(Setting({"sensor": {"depth_noise": {}}, "check": {"raycast_share": 1.0}}))
    stages = {effect.name: effect.stage for effect in EFFECTS}
    assert {stages[name] for name in made.scene.effects.ran} <= made.watch.seconds.keys()
    assert set(made.watch.effects) <= set(made.scene.effects.ran)
    assert {"dynamics", "release_again", "light_maps", "depth_camera", "mirror", "projection", "raycast_check",
            "exact_agreement", "sensor_depth_noise"} == set(made.watch.effects)  # fmt: skip
    assert all(seconds > 0.0 for seconds in made.watch.effects.values())
    assert sum(made.watch.effects.values()) < 2.0 * sum(made.watch.seconds.values())


def test_the_manifest_has_the_seconds_of_each_effect_and_they_add_nothing_to_the_scenes():
    watch = Stopwatch()
    with watch.effect("mirror"):
        for _ in range(2):
            with watch.stage("render"):
                pass
        with watch.stage("recheck", "release_again"):
            pass
    row: Any = timing_row(3, "mug", watch)
    assert {one["name"]: one["seconds"] for one in row["effects"]} == watch.effects
    assert set(watch.effects) == {"mirror", "release_again"}
    assert watch.effects["mirror"] >= watch.effects["release_again"] == watch.seconds["recheck"]
    assert row["total_s"] == watch.seconds["render"] + watch.seconds["recheck"]


def test_an_effect_that_did_not_run_has_no_time():
    watch = make(NO_OPS["light_maps"].spares).watch
    assert not {"light_maps", "raycast_check", "release_again", "exact_agreement"} & set(watch.effects)
