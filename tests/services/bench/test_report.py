"""The report of rounds that were made up."""

import pytest

from services.bench.figures import Lap
from services.bench.measure import Measured
from services.bench.report import describe, summarise
from services.bench.script import LOOKS

MACHINE = {
    "usable_cores": 2,
    "cores": 4,
    "threads_per_core": 2,
    "cpu": "some",
    "load_1min": 0.25,
    "gl_renderer": "soft",
    "python": "3.11",
    "versions": {"numpy": "2"},
}
LAPS = {
    "ours": [Lap(4, 2.0, 1.6, {"render": 1.0}), Lap(2, 1.0, 0.8, {"render": 0.6})],
    "floor": [Lap(4, 0.5, 0.4, {"draw": 0.5}, 0.1), Lap(2, 0.5, 0.4, {"draw": 0.5}, 0.1)],
    "script_plain": [Lap(4, 8.0, 6.4, {"render": 8.0}, 2.0), Lap(2, 3.0, 2.4, {"render": 3.0}, 1.0)],
}
GAIN = {
    "scenes": 8,
    "one_scenes_per_s": 1.0,
    "all_scenes_per_s": 1.9,
    "speedup": {"median": 1.9, "least": 1.8, "most": 2.0},
    "inflation": {"median": 1.1, "least": 1.0, "most": 1.2},
}
SHARE = {"median": 0.05, "least": 0.04, "most": 0.061}


def test_ratios_are_of_slopes_and_the_text_tells_them():
    figures = summarise(Measured(MACHINE, 1, LAPS, 6000, {"rgb": "ours"}, {"plain": LOOKS["plain"]}, {"ours": 3.0}))
    assert (figures["scenes"], figures["rounds"], figures["bytes_per_scene"]) == (6, 2, 1000.0)
    assert figures["times_floor"] == pytest.approx({"median": 3.0, "least": 2.0, "most": 4.0})
    script = figures["others"]["script_plain"]
    assert script["ratio"] == pytest.approx({"median": 3.5, "least": 3.0, "most": 4.0})
    assert script["load_ms"] == pytest.approx(500.0)
    scaling = {"workers": 2, "range": 8, "ray": GAIN, "bare": GAIN, "ray_share": SHARE, "ray_share_one": SHARE}
    rest = {"command": "verso bench", "file_system": "ext4"}
    lines = describe({**figures, **rest, "memory": None, "scaling": {**scaling, "loops": SHARE, "share_of_bare": 0.97}})
    assert "machine    2 of 4 cores (2 threads each), some, load 0.2" in lines
    assert any(line.startswith("  the script, plain look 3.50 x [3.00 to 4.00]") for line in lines)
    assert any("5.0% [4.0% to 6.1%] with one worker" in line for line in lines)
    assert "  empty loops            0.05 x [0.04 to 0.06]" in lines
