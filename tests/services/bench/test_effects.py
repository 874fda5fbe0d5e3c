"""What the plan of effects saves: the figures follow from the times, and the times from settling."""

import json

import numpy as np
import pytest

from schemas.errors import RunError
from services.bench import effects
from services.bench.effects import (
    EVERYTHING,
    FORCED,
    PLAN,
    WHOLE,
    describe,
    summarise,
    time_settling,
)
from services.cli.main import main
from tests.effects.physics_scenes import facts_with
from tests.hard_cases.bodies import built_in, cube
from tests.hard_cases.drops import drop, level
from workers.physics.effects import PREDICATES
from workers.scene.effects import names_of_kind

NEVER = np.full((2, 3), np.nan)

TIMED = (
    {
        **dict.fromkeys(FORCED, NEVER),
        PLAN: np.array([[0.01, 0.02, 0.5], [0.02, 0.02, 0.5]]),
        WHOLE: np.array([[0.04, 0.08, np.nan], [0.04, 0.04, np.nan]]),
        EVERYTHING: np.array([[0.1, 0.2, 0.9], [0.2, 0.2, 0.9]]),
        "table_mesh": np.array([[0.03, np.nan, 0.7], [0.06, np.nan, 0.8]]),
    },
    {**dict.fromkeys(FORCED, 0), WHOLE: 1},
)
"""Two rounds of three scenes, the last of which does not come to rest in one of the ways."""


def test_the_share_saved_is_of_the_time_of_all_scenes_that_come_to_rest_in_every_way():
    figures = summarise(*TIMED)
    assert (figures["scenes"], figures["rounds"]) == (2, 2)
    assert figures["plan"] == pytest.approx({"median_ms": 17.5, "mean_ms": 17.5})
    hulls, parts = figures["forced"][WHOLE], figures["forced"][EVERYTHING]
    assert hulls["saved"] == pytest.approx({"median": 0.625, "least": 0.5, "most": 0.75})
    assert parts["saved"] == pytest.approx({"median": 0.9, "least": 0.9, "most": 0.9})
    assert hulls["median_ms"] == pytest.approx(50.0) and parts["mean_ms"] == pytest.approx(175.0)


def test_an_effect_costs_what_it_adds_in_the_scenes_that_leave_it_out():
    costs = summarise(*TIMED)["effects"]
    assert costs["table_mesh"]["scenes"] == 2
    assert costs["table_mesh"]["more_ms"] == pytest.approx({"median": 140.0, "least": 110.0, "most": 170.0})
    assert costs["dynamics"] == {"scenes": 0, "more_ms": None}


def test_every_approximation_is_forced_alone_and_with_the_others_once_without_decomposition():
    approximations = names_of_kind("approximation") & PREDICATES.keys()
    assert FORCED.keys() == {PLAN, WHOLE, EVERYTHING} | approximations
    assert FORCED[PLAN] == frozenset() and FORCED[EVERYTHING] == approximations
    assert FORCED[EVERYTHING] - FORCED[WHOLE] == {"decomposition"}
    assert all(FORCED[name] == {name} for name in approximations)


def test_settling_is_timed_in_each_way_but_not_with_an_effect_that_the_plan_has():
    timed = time_settling([facts_with(drop(built_in("mug"), level()))], rounds=2)
    seconds, failed = timed
    assert all(found.shape == (2, 1) for found in seconds.values())
    for name, found in seconds.items():
        if name in ("dynamics", "fine_step", "rolling_friction"):
            assert np.isnan(found).all()
        else:
            assert (found > 0.0).all()
    assert seconds[EVERYTHING].sum() > seconds[PLAN].sum()
    assert set(failed.values()) == {0}


def test_what_does_not_come_to_rest_is_counted_and_refused_where_nothing_does():
    over_nothing = facts_with(drop(cube(), level(), xy=(0.9, 0.0)))
    with pytest.raises(RunError, match="none of 1 scenes"):
        time_settling([over_nothing], rounds=1)
    timed = time_settling([over_nothing, facts_with(drop(cube(), level()))], rounds=1)
    assert timed[1][PLAN] == 1
    assert summarise(*timed)["scenes"] == 1


def test_two_scenes_of_a_job_are_told_of_in_words_and_in_json(monkeypatch, capsys):
    monkeypatch.setattr(effects, "ROUNDS", 1)
    job = ["--set", "name=two", "--set", "categories=[laptop]"]
    assert main(["bench", "--effects", "2", "--json", *job]) == 0
    *lines, answer = capsys.readouterr().out.splitlines()
    figures = json.loads(answer)
    assert (figures["job"], figures["scenes"], figures["rounds"]) == ("two", 2, 1)
    for name in (WHOLE, EVERYTHING):
        side = figures["forced"][name]
        assert side["saved"]["median"] == pytest.approx(1.0 - figures["plan"]["mean_ms"] / side["mean_ms"])
        assert side["mean_ms"] > figures["plan"]["mean_ms"]
    assert figures["effects"]["rolling_friction"]["scenes"] == 2
    assert figures["effects"]["dynamics"]["more_ms"] is None
    assert lines == describe(figures)
    assert any("all but decomposition forced" in line and "the plan saves" in line for line in lines)
