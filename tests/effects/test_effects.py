"""Every effect on a scene that needs it and on one that does not: what the plan chooses, and what forcing changes."""

import importlib.util

import pytest

from tests.effects.cases import ASKED, NO_OPS, OF_OTHERS, Case
from tests.effects.physics_cases import PHYSICS
from tests.effects.scenes import Setting, facts_of, make
from workers.scene.effects import EFFECTS, names_of_kind, plan_effects, write_receipt

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
    assert all(effect.stage for effect in EFFECTS)


@pytest.mark.parametrize("name", CASES)
def test_the_plan_runs_it_where_the_scene_needs_it_and_says_why_not_elsewhere(name):
    needs, spares = plan_effects(facts_of(CASES[name].needs)), plan_effects(facts_of(CASES[name].spares))
    assert needs.runs(name) and name not in needs.skipped
    assert not spares.runs(name)
    why, _, proof = spares.skipped[name].partition("; proof: ")
    assert why == CASES[name].why and bool(proof) is (name not in ASKED)


@pytest.mark.parametrize("name", ASKED)
def test_a_switch_of_the_job_changes_what_is_stored(name):
    if name in ("global_illumination", "glass") and not importlib.util.find_spec("mitsuba"):
        pytest.skip("mitsuba is not installed: `./verso extra pathtraced`")
    needs, spares = make(ASKED[name].needs), make(ASKED[name].spares)
    assert (needs.files, needs.rows) != (spares.files, spares.rows)


@pytest.mark.parametrize("name", NO_OPS)
def test_forcing_a_no_op_where_nothing_calls_for_it_changes_no_byte(name):
    plain, forced = make(NO_OPS[name].spares), make(NO_OPS[name].spares, forced={name})
    assert plain.files == forced.files
    assert plain.rows == forced.rows
    assert not plain.scene.effects.runs(name)
    assert forced.scene.effects.runs(name)
    if name in CHECKS_ONLY:
        assert name in forced.stopwatch.effects and name not in plain.stopwatch.effects


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
    told = {*ran, *(one["effect"] for one in skipped)}
    assert {effect.name for effect in EFFECTS} - told == OF_OTHERS


def test_every_effect_that_ran_is_timed_within_a_stage_that_was_timed():
    made = make(Setting({"sensor": {"depth_noise": {}}, "check": {"raycast_share": 1.0}}))
    stages = {effect.name: effect.stage for effect in EFFECTS}
    assert {stages[name] for name in made.scene.effects.ran} <= made.stopwatch.seconds.keys()
    assert set(made.stopwatch.effects) <= set(made.scene.effects.ran)
    assert {"dynamics", "release_again", "light_maps", "depth_camera", "mirror", "projection", "raycast_check",
            "exact_agreement", "sensor_depth_noise"} == set(made.stopwatch.effects)  # fmt: skip
    assert all(seconds > 0.0 for seconds in made.stopwatch.effects.values())
    assert sum(made.stopwatch.effects.values()) < 2.0 * sum(made.stopwatch.seconds.values())


def test_an_effect_that_did_not_run_has_no_time():
    timed = make(NO_OPS["light_maps"].spares).stopwatch.effects
    assert not {"light_maps", "raycast_check", "release_again", "exact_agreement"} & set(timed)
