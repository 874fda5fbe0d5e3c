"""Every effect, taken out of the plan of a scene that calls for it, is taken out of the run."""

import importlib.util

import pytest

from tests.effects.proofs import PROOFS, attempt
from tests.effects.scenes import Made, Setting, facts_of
from workers.scene.effects import EFFECTS, plan_effects

TRACED_EFFECTS = ("global_illumination", "glass")

OF_SECONDS = ("decomposition", "glass", "raycast_check", "environment", "release_again", "global_illumination")
"""Effects whose scene takes two seconds, of which tier, label and fall others stand for by default."""


@pytest.mark.parametrize(
    "name", [pytest.param(e.name, marks=[pytest.mark.minute] * (e.name in OF_SECONDS)) for e in EFFECTS]
)
def test_an_effect_that_is_taken_out_of_the_plan_is_taken_out_of_the_run(name):
    if name in TRACED_EFFECTS and not importlib.util.find_spec("mitsuba"):
        pytest.skip("mitsuba is not installed: `./verso extra pathtraced`")
    proof = PROOFS[name]
    assert plan_effects(facts_of(proof.scene)).runs(name)
    present, absent = attempt(proof.scene), attempt(proof.scene, name)
    assert proof.shows(present, absent), f"{name}: {present} and without it {absent}"
    for outcome, runs in ((present, True), (absent, False)):
        assert not isinstance(outcome, Made) or outcome.scene.effects.runs(name) is runs


def test_an_effect_taken_out_of_a_plan_keeps_the_others_and_their_reasons():
    plan = plan_effects(facts_of(Setting({})), frozenset({"table"}))
    less = plan.without("table", "mirror", "samples")
    assert set(plan.ran) - set(less.ran) == {"table", "mirror"}
    assert less.skipped == {**plan.skipped, "table": "withdrawn", "mirror": "withdrawn"}
    assert less.forced == frozenset()
    assert plan.runs("table") and not less.runs("table")
