"""The plan of a capture's effects: what is asked for runs, everything else says why not."""

import pytest

from schemas.job.captures import Simulate
from workers.capture.simulate.simulate import ASKED, plan_effects, planned_settings

EMPTY = {"print_scale": 1.02}
"""Settings that are numbers; the others are branches with defaults."""


def test_nothing_is_simulated_that_is_not_asked_for():
    plan = plan_effects(Simulate())
    assert not set(ASKED) & set(plan.ran)
    assert set(ASKED) <= set(plan.skipped)


@pytest.mark.parametrize("name", ASKED)
def test_an_effect_runs_where_it_is_asked_for_and_no_other_does(name):
    plan = plan_effects(Simulate(**{name: EMPTY.get(name, {})}))
    assert [effect for effect in ASKED if plan.runs(effect)] == [name]
    assert name not in plan.skipped


def test_every_optional_setting_is_in_the_table():
    optional = {name for name, field in Simulate.model_fields.items() if field.default is None}
    assert optional == set(ASKED)


def test_each_tier_has_its_own_light():
    assert plan_effects(Simulate()).runs("shadows")
    assert not plan_effects(Simulate()).runs("glass")
    assert plan_effects(Simulate(tier="pathtraced")).runs("glass")
    assert not plan_effects(Simulate(tier="pathtraced")).runs("shadows")


def test_an_effect_that_is_withdrawn_is_off_in_the_settings():
    simulate = Simulate(**{name: EMPTY.get(name, {}) for name in ASKED})
    for name in ASKED:
        planned = planned_settings(simulate, plan_effects(simulate).without(name))
        assert [effect for effect in ASKED if getattr(planned, effect) is None] == [name]
    assert planned_settings(simulate, plan_effects(simulate)) == simulate
