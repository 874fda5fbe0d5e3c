"""The figures of a benchmark, from times that were made up, and the gain of several workers."""

import contextlib
import os
import re

import pytest

from services.bench import command
from services.bench.command import gain_of, measure_scaling
from services.bench.figures import Lap, by_processor, pinned, slope_ratio, summarise_side
from services.bench.measure import Measured
from services.job.job_file import validate_job
from tests.datasets import SMALL as ANY_SMALL

JOB = validate_job({**ANY_SMALL, "run": {"range_size": 2}}, "test")


def test_ratios_are_of_slopes_and_by_pairs_and_stages_are_per_scene():
    slow = [Lap(10, 20.0, 9.0, {}), Lap(10, 30.0, 8.0, {}), Lap(5, 5.0, 2.0, {})]
    fast = [Lap(10, 4.0, 3.0, {}), Lap(10, 5.0, 2.0, {}), Lap(10, 5.0, 2.0, {})]
    assert slope_ratio(slow, fast) == {"median": 5.0, "least": 2.0, "most": 6.0}
    assert slope_ratio(slow, fast, by_processor) == {"median": 3.0, "least": 2.0, "most": 4.0}
    with pytest.raises(ValueError, match="shorter"):
        slope_ratio(slow, fast[:2])
    laps = [Lap(2, 1.0, 0.8, {"render": 0.5, "write": 0.25}, 0.5), Lap(4, 2.0, 1.2, {"render": 1.0}, 2.0)]
    side = summarise_side([*laps, Lap(1, 1.0, 1.0, {"rays": 0.75})])
    assert (side["ms_per_scene"], side["cpu_ms_per_scene"], side["apart_ms"]) == pytest.approx((500.0, 400.0, 250.0))
    assert side["stages_ms"] == pytest.approx({"render": 250.0, "write": 0.0, "rays": 0.0, "rest": 250.0})
    assert side["stages_mean_ms"]["rays"] == 250.0


def test_the_core_is_given_back_after_an_error():
    before = os.sched_getaffinity(0)
    with contextlib.suppress(KeyError), pinned() as core:
        assert os.sched_getaffinity(0) == {core}
        raise KeyError(core)
    assert os.sched_getaffinity(0) == before


def test_the_report_tells_the_ratios_in_figures_and_in_words():
    machine = {"usable_cores": 2, "cores": 4, "cpu": "some", "load_1min": 0.25}
    machine |= {"gl_renderer": "soft", "python": "3.11", "versions": {"numpy": "2"}}
    ours = [Lap(4, 2.0, 1.6, {"render": 1.0}), Lap(2, 1.0, 0.8, {"render": 0.6})]
    floor = [Lap(4, 0.5, 0.4, {"draw": 0.5}, 0.1), Lap(2, 0.5, 0.4, {"draw": 0.5}, 0.1)]
    script = {"plain": [Lap(4, 8.0, 6.4, {"render": 8.0}, 2.0), Lap(2, 3.0, 2.4, {"render": 3.0}, 1.0)]}
    figures = command.summarise(Measured(machine, 1, 6000, ours, floor, script))
    assert (figures["scenes"], figures["rounds"], figures["bytes_per_scene"]) == (6, 2, 1000.0)
    assert figures["times_floor"] == pytest.approx({"median": 3.0, "least": 2.0, "most": 4.0})
    assert figures["script"]["plain"]["ratio"] == pytest.approx({"median": 3.5, "least": 3.0, "most": 4.0})
    gain = gain_of([Lap(10, 10.0, 9.0, {}), Lap(10, 20.0, 9.0, {})], [Lap(10, 6.0, 10.8, {}), Lap(10, 10.0, 9.9, {})])
    assert gain["speedup"] == pytest.approx({"median": 11 / 6, "least": 10 / 6, "most": 2.0})
    assert gain["inflation"] == pytest.approx({"median": 1.15, "least": 1.1, "most": 1.2})
    assert (gain["one_scenes_per_s"], gain["all_scenes_per_s"]) == pytest.approx((0.75, (10 / 6 + 1.0) / 2))
    shares = {name: {"median": 0.05, "least": 0.04, "most": 0.061} for name in ("ray_share", "ray_share_one")}
    scaled = {"workers": 2, "range": 8, "ray": gain, "bare": gain, "share_of_bare": 0.97, **shares}
    lines = command.describe({**figures, "command": "verso bench", "file_system": "ext4", "scaling": scaled})
    for words in (
        r"machine    2 of 4 cores, some, load 0\.2",
        r"    render +275\.00 ms  55\.0%, mean 275\.00 ms",
        r"  before its clock it reads its files: 500\.0 ms a scene",
        r"  the script, plain +3\.50 x \[3\.00 to 4\.00\] +3\.50 x .*",
        r"times the lower bound +3\.00 x \[2\.00 to 4\.00\] .*",
        r".* 5\.0% \[4\.0% to 6\.1%\] with one worker, .*",
    ):
        assert any(re.fullmatch(words, line) for line in lines), (words, lines)


@pytest.mark.slow
@pytest.mark.ray
def test_scaling_tells_rays_part_from_the_machines(tmp_path):
    scaling = measure_scaling(JOB, tmp_path, tmp_path, workers=2, scenes=8, rounds=1)
    assert scaling["ray"]["scenes"] == scaling["bare"]["scenes"] == 8
    assert 0 < scaling["ray_share_one"]["median"] < 1 and 0 < scaling["ray_share"]["median"] < 1
    assert all(0.2 < scaling[name]["inflation"]["median"] < 5 for name in ("ray", "bare"))
