"""The plan of a capture's effects: what is asked for runs, everything else says why not."""

import pytest

from schemas.job.captures import Simulate
from workers.capture.simulate.simulate import planned_settings
from workers.scene.effects import CAPTURE_EFFECTS, plan_capture

EMPTY = {"print_scale": 1.02}
"""Settings that are numbers; the others are branches with defaults."""


def test_nothing_is_simulated_that_is_not_asked_for():
    plan = plan_capture(Simulate())
    assert not set(CAPTURE_EFFECTS) & set(plan.ran)
    assert set(CAPTURE_EFFECTS) <= set(plan.skipped)


@pytest.mark.parametrize("name", CAPTURE_EFFECTS)
def test_an_effect_runs_where_it_is_asked_for_and_no_other_does(name):
    plan = plan_capture(Simulate(**{name: EMPTY.get(name, {})}))
    assert [effect for effect in CAPTURE_EFFECTS if plan.runs(effect)] == [name]
    assert name not in plan.skipped


def test_each_tier_has_its_own_light():
    assert plan_capture(Simulate()).runs("shadows")
    assert not plan_capture(Simulate()).runs("glass")
    assert plan_capture(Simulate(tier="pathtraced")).runs("glass")
    assert not plan_capture(Simulate(tier="pathtraced")).runs("shadows")


def test_an_effect_that_is_withdrawn_is_off_in_the_settings():
    simulate = Simulate(**{name: EMPTY.get(name, {}) for name in CAPTURE_EFFECTS})
    for name in CAPTURE_EFFECTS:
        planned = planned_settings(simulate, plan_capture(simulate).without(name))
        assert [effect for effect in CAPTURE_EFFECTS if getattr(planned, effect) is None] == [name]
    assert planned_settings(simulate, plan_capture(simulate)) == simulate
