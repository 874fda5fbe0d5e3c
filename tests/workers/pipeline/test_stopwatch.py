"""Where the time of a scene goes."""

from typing import Any

import pytest

from workers.scene.context import Stopwatch
from workers.scene.rows import timing_row


def test_the_manifest_has_the_seconds_of_each_effect_and_they_add_nothing_to_the_scenes():
    stopwatch = Stopwatch()
    with stopwatch.effect("mirror"):
        for _ in range(2):
            with stopwatch.stage("render"):
                pass
        with stopwatch.stage("recheck", "release_again"):
            pass
    row: Any = timing_row(3, "mug", stopwatch)
    assert {one["name"]: one["seconds"] for one in row["effects"]} == stopwatch.effects
    assert set(stopwatch.effects) == {"mirror", "release_again"}
    assert stopwatch.effects["mirror"] >= stopwatch.effects["release_again"] == stopwatch.seconds["recheck"]
    assert row["total_s"] == stopwatch.seconds["render"] + stopwatch.seconds["recheck"]


def test_what_runs_twice_adds_up_and_a_block_that_raises_is_counted(monkeypatch):
    ticks = iter([0.0, 1.0, 10.0, 12.0, 20.0, 23.0])
    monkeypatch.setattr("workers.scene.context.time.perf_counter", lambda: next(ticks))
    stopwatch = Stopwatch()
    for _ in range(2):
        with stopwatch.stage("render", "mirror"):
            pass
    with pytest.raises(ValueError, match="broken"), stopwatch.stage("render"):
        raise ValueError("broken")
    assert stopwatch.seconds == {"render": 6.0}
    assert stopwatch.effects == {"mirror": 3.0}


def test_a_total_adds_the_stages_of_its_scenes():
    total = Stopwatch({"render": 1.0})
    total.add(Stopwatch({"render": 2.0, "check": 3.0}, {"mirror": 1.0}))
    assert total.seconds == {"render": 3.0, "check": 3.0}
