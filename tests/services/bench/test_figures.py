"""The figures of a benchmark: from times that were made up, of settling with effects forced, and of several workers."""

import contextlib
import dataclasses
import json
import os
import pickle
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace

import numpy as np
import pytest
from ray._common.utils import get_ray_address_file

from schemas.capture import CaptureCamera, CapturedView
from schemas.dataset.commit import Span
from schemas.errors import MachineError, RunError
from schemas.job.captures import Board
from schemas.scene.shape import Mesh
from services.bench import captures, command, effects, marker_script, scaling
from services.bench.command import PACKAGES, require_extra
from services.bench.effects import EVERYTHING, FORCED, PLAN, WHOLE, time_settling
from services.bench.figures import (
    Lap,
    Spread,
    by_processor,
    pinned,
    process_age_s,
    slope_ratio,
    stage_table,
    threads_per_core,
    with_loading,
)
from services.bench.measure import Measured, Sample, memory_figures
from services.bench.scaling import (
    compare,
    gain_of,
    measure_scaling,
    measure_simulated,
    plain_processes,
    simulated_nodes,
    sleeping,
)
from services.bench.sides import LOOKS
from services.cli.main import main
from services.job.job_file import validate_job
from tests.datasets import SMALL as ANY_SMALL
from tests.effects.physics_scenes import facts_with
from tests.hard_cases.bodies import cube
from tests.hard_cases.drops import drop, level
from tests.services.run.test_coordinator import spans
from tests.workers.capture.drawn import KINECT, errors, hand_held, photograph
from workers.capture.folder import CaptureFile, write_description, write_view
from workers.physics.effects import PREDICATES
from workers.scene.effects import names_of_kind

ROOT = Path(__file__).resolve().parents[3]
SMALL = {**ANY_SMALL, "run": {"range_size": 2}}
JOB = validate_job(SMALL, "test")

# ---------------------------------------------------------------------------------------------- laps


def test_ratios_are_of_slopes_and_by_pairs_and_stages_are_per_scene():
    slow = [Lap(10, 20.0, 9.0, {}, 5.0), Lap(10, 30.0, 8.0, {}, 5.0), Lap(5, 5.0, 2.0, {}, 5.0)]
    fast = [Lap(10, 4.0, 3.0, {}), Lap(10, 5.0, 2.0, {}), Lap(10, 5.0, 2.0, {})]
    assert slope_ratio(slow, fast) == Spread(5.0, 2.0, 6.0)
    assert slope_ratio(slow, fast, by_processor) == Spread(3.0, 2.0, 4.0)
    assert slope_ratio(slow, fast, with_loading) == Spread(6.25, 4.0, 7.0)
    with pytest.raises(ValueError, match="shorter"):
        slope_ratio(slow, fast[:2])
    laps = [Lap(2, 1.0, 1.0, {"render": 0.5, "write": 0.25}), Lap(4, 2.0, 2.0, {"render": 1.0})]
    assert stage_table(laps) == {"render": 250.0, "write": 62.5, "rest": 187.5}
    assert stage_table([*laps, Lap(1, 1.0, 1.0, {"rays": 0.75})], fmean)["rays"] == 250.0


def test_the_machine_is_described_and_its_cores_are_given_back_after_an_error(tmp_path):
    before = os.sched_getaffinity(0)
    with contextlib.suppress(KeyError), pinned() as core:
        assert os.sched_getaffinity(0) == {core}
        raise KeyError(core)
    assert os.sched_getaffinity(0) == before
    for siblings, threads in {"0": 1, "0-1": 2, "0,64": 2, "0-1,8-9": 4}.items():
        (tmp_path / "siblings").write_text(siblings + "\n")
        assert threads_per_core(tmp_path / "siblings") == threads
    assert threads_per_core(tmp_path / "nothing") is None
    age = process_age_s()
    assert 0.0 < age <= process_age_s()


def test_memory_and_pace_are_compared_after_a_tenth_of_the_scenes_or_two_hundred():
    samples = [Sample(16, 100.0 + n, 0.1) for n in range(13)]
    samples += [Sample(16, 120.0, 0.2)] * 100 + [Sample(7, 117.6, 0.11)] * 13
    told = memory_figures(samples, peak_mb=130.0)
    assert told["scenes"] == 113 * 16 + 13 * 7
    # 192: the end of the first range that holds a tenth of them
    assert (told["settled_after"], told["settled_mb"], told["last_mb"], told["peak_mb"]) == (192, 111.0, 117.6, 130.0)
    assert told["grown"] == pytest.approx(117.6 / 111.0 - 1.0) and told["last_to_first"] == pytest.approx(1.1)
    assert (told["first_ms"], told["last_ms"]) == pytest.approx((100.0, 110.0))
    assert memory_figures([Sample(16, 100.0, 0.1)] * 125, peak_mb=100.0)["settled_after"] == 208


def test_the_report_tells_the_ratios_in_figures_and_in_words():
    machine = {"usable_cores": 2, "cores": 4, "threads_per_core": 2, "cpu": "some", "load_1min": 0.25}
    machine |= {"gl_renderer": "soft", "python": "3.11", "versions": {"numpy": "2"}}
    laps = {
        "ours": [Lap(4, 2.0, 1.6, {"render": 1.0}), Lap(2, 1.0, 0.8, {"render": 0.6})],
        "floor": [Lap(4, 0.5, 0.4, {"draw": 0.5}, 0.1), Lap(2, 0.5, 0.4, {"draw": 0.5}, 0.1)],
        "script_plain": [Lap(4, 8.0, 6.4, {"render": 8.0}, 2.0), Lap(2, 3.0, 2.4, {"render": 3.0}, 1.0)],
    }
    measured = Measured(machine, 1, laps, 6000, {"rgb": "ours"}, {"plain": LOOKS["plain"]}, {"ours": 3.0})
    figures = command.summarise(measured)
    assert (figures["scenes"], figures["rounds"], figures["bytes_per_scene"]) == (6, 2, 1000.0)
    assert figures["times_floor"] == pytest.approx({"median": 3.0, "least": 2.0, "most": 4.0})
    script = figures["others"]["script_plain"]
    assert script["ratio"] == pytest.approx({"median": 3.5, "least": 3.0, "most": 4.0})
    assert script["load_ms"] == pytest.approx(500.0)
    share = {"median": 0.05, "least": 0.04, "most": 0.061}
    gain = gain_of([Lap(10, 10.0, 9.0, {}), Lap(10, 20.0, 9.0, {})], [Lap(10, 6.0, 10.8, {}), Lap(10, 10.0, 9.9, {})])
    assert gain["speedup"] == pytest.approx({"median": 11 / 6, "least": 10 / 6, "most": 2.0})
    assert gain["inflation"] == pytest.approx({"median": 1.15, "least": 1.1, "most": 1.2})
    assert (gain["one_scenes_per_s"], gain["all_scenes_per_s"]) == pytest.approx((0.75, (10 / 6 + 1.0) / 2))
    shares = dict.fromkeys(("ray_share", "ray_share_one", "loops"), share)
    scaled = {"workers": 2, "range": 8, "ray": gain, "bare": gain, "share_of_bare": 0.97, **shares}
    memory = memory_figures([Sample(16, 100.0, 0.1)] * 125, peak_mb=110.0)
    asked = {"command": "verso bench", "file_system": "ext4", "memory": memory, "scaling": scaled}
    lines = command.describe({**figures, **asked})
    assert "machine    2 of 4 cores (2 threads each), some, load 0.2" in lines
    assert "  empty loops            0.05 x [0.04 to 0.06]" in lines
    for words in (
        "  the script, plain look 3.50 x [3.00 to 4.00]",
        "100 MB after 208, 100 MB at the end: +0.0%; at most 110 MB",
    ):
        assert any(words in line for line in lines)
    assert any("5.0% [4.0% to 6.1%] with one worker" in line for line in lines)


# ---------------------------------------------------------------------------------------------- effects


def test_the_share_that_the_plan_saves_is_of_the_scenes_that_come_to_rest_in_every_way():
    """Two rounds of three scenes, the last of which does not come to rest in one of the ways."""
    seconds = {
        **dict.fromkeys(FORCED, np.full((2, 3), np.nan)),
        PLAN: np.array([[0.01, 0.02, 0.5], [0.02, 0.02, 0.5]]),
        WHOLE: np.array([[0.04, 0.08, np.nan], [0.04, 0.04, np.nan]]),
        EVERYTHING: np.array([[0.1, 0.2, 0.9], [0.2, 0.2, 0.9]]),
        "table_mesh": np.array([[0.03, np.nan, 0.7], [0.06, np.nan, 0.8]]),
    }
    figures = effects.summarise(seconds, {**dict.fromkeys(FORCED, 0), WHOLE: 1})
    assert (figures["scenes"], figures["rounds"]) == (2, 2)
    assert figures["plan"] == pytest.approx({"median_ms": 17.5, "mean_ms": 17.5})
    hulls, parts = figures["forced"][WHOLE], figures["forced"][EVERYTHING]
    assert hulls["saved"] == pytest.approx({"median": 0.625, "least": 0.5, "most": 0.75})
    assert parts["saved"] == pytest.approx({"median": 0.9, "least": 0.9, "most": 0.9})
    assert hulls["median_ms"] == pytest.approx(50.0) and parts["mean_ms"] == pytest.approx(175.0)
    costs = figures["effects"]
    assert costs["table_mesh"]["scenes"] == 2 and costs["dynamics"] == {"scenes": 0, "more_ms": None}
    assert costs["table_mesh"]["more_ms"] == pytest.approx({"median": 140.0, "least": 110.0, "most": 170.0})
    approximations = names_of_kind("approximation") & PREDICATES.keys()
    assert FORCED[PLAN] == frozenset() and FORCED[EVERYTHING] == approximations
    assert FORCED[EVERYTHING] - FORCED[WHOLE] == {"decomposition"}
    assert all(FORCED[name] == {name} for name in approximations)


def test_what_does_not_come_to_rest_is_counted_and_refused_where_nothing_does():
    facts = facts_with(drop(cube(), level(), xy=(0.9, 0.0)))
    start = facts.job.start.model_copy(update={"if_lost": "fail"})
    over_nothing = dataclasses.replace(facts, job=facts.job.model_copy(update={"start": start}))
    with pytest.raises(RunError, match="none of 1 scenes"):
        time_settling([over_nothing], rounds=1)
    timed = time_settling([over_nothing, facts_with(drop(cube(), level()))], rounds=1)
    assert timed[1][PLAN] == 1 and effects.summarise(*timed)["scenes"] == 1


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
    # An effect that the plan has is not forced.
    assert figures["effects"]["rolling_friction"]["scenes"] == 2 and figures["effects"]["dynamics"]["more_ms"] is None
    assert any("all but decomposition forced" in line and "the plan saves" in line for line in lines)


def test_image_targets_are_compared_with_the_same_scenes_without():
    """Of three scenes, the last of which could not be made, all targets take twice and four times as long."""
    seconds = {name: np.array([[0.1, 0.2, np.nan]] * 2) for name in effects.TARGETS}
    seconds["all"] = np.array([[0.2, 0.8, np.nan], [0.4, 0.8, np.nan]])
    figures = effects.summarise_targets(seconds)
    assert (figures["scenes"], figures["rounds"]) == (2, 2)
    assert figures["targets"]["all"]["ratio"] == pytest.approx({"median": 3.5, "least": 3.0, "most": 4.0})
    assert figures["targets"]["layers"]["ratio"]["median"] == 1.0 and figures["targets"]["none"]["mean_ms"] == 150.0
    with pytest.raises(RunError, match="none of 3 scenes"):
        effects.summarise_targets(dict.fromkeys(effects.TARGETS, np.full((2, 3), np.nan)))


def test_the_targets_of_a_scene_are_told_of_in_words_and_in_json(monkeypatch, capsys):
    monkeypatch.setattr(effects, "ROUNDS", 1)
    assert main(["bench", "--targets", "1", "--json", "--set", "categories=[laptop]"]) == 0
    *lines, answer = capsys.readouterr().out.splitlines()
    sides = json.loads(answer)["targets"]
    assert [*sides] == [*effects.TARGETS] and sides["none"]["ratio"]["median"] == 1.0 < sides["all"]["ratio"]["median"]
    assert any(line.startswith("all ") and "times a scene without" in line for line in lines)


# ---------------------------------------------------------------------------------------------- several at once


@pytest.mark.minute
def test_plain_processes_make_the_same_scenes_at_the_same_time(tmp_path):
    with plain_processes(JOB, tmp_path, tmp_path, 2) as processes:
        both, loops = processes.run("both", 2, Span(start=0, stop=3)), processes.loop(2, 0.2)
    assert [lap.scenes for lap in both] == [3, 3] and all(lap.cpu_s > 0 for lap in both)
    for number in (0, 1):
        commits = (tmp_path / f"bare{number}" / "both" / "manifest" / "_commits").glob("*.json")
        assert sorted(int(path.stem) for path in commits) == [0, 2]
    assert all(lap.scenes > 0 and lap.cpu_s <= lap.wall_s < 1.0 for lap in loops)


@pytest.mark.slow
@pytest.mark.ray
def test_scaling_tells_rays_part_from_the_machines(tmp_path):
    told = measure_scaling(JOB, tmp_path, tmp_path, workers=2, scenes=8, rounds=1)
    assert told["ray"]["scenes"] == told["bare"]["scenes"] == 8
    assert 0 < told["ray_share_one"]["median"] < 1 and 0 < told["ray_share"]["median"] < 1
    assert all(0.2 < told[name]["inflation"]["median"] < 5 for name in ("ray", "bare"))
    assert 0.5 < told["loops"]["median"] < 2.5


def test_the_overhead_is_of_the_shards_between_a_short_and_a_long_run():
    """2 and 12 shards of 0.5 s on 4 slots, 0.8 s to begin, 0.05 s more for each."""
    figures = compare((0.8 + 2 * 0.55, 0.3 + 8 * 0.002), (0.8 + 12 * 0.55, 0.3 + 48 * 0.002), 4, 0.5)
    assert figures == pytest.approx({"overhead": 0.1, "start_s": 0.8, "shards_per_s": 4 / 0.55, "coordinator_ms": 2.0})
    lap = {"nodes": 16, "shard_s": 2.0, "overhead": 0.031, "start_s": 0.84, "shards_per_s": 7.7, "coordinator_ms": 1.25}
    line = scaling.describe({"simulated": [lap]})[-1]
    assert line.split() == ["16", "2.0", "s", "3.1%", "0.84", "s", "7.7", "1.25", "ms/shard"]
    made = sleeping(0.0)(None, pickle.dumps(SimpleNamespace(spans=spans(0, 2, 8))), b"")
    assert [(span.start, span.stop, span.made) for span in made.spans] == [(0, 2, 2), (2, 4, 2), (8, 10, 2)]


def command_of(pid: str) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


@pytest.mark.slow
@pytest.mark.ray
def test_simulated_nodes_take_the_time_of_their_shards_and_leave_no_process_and_no_address(tmp_path):
    """Ray notes the address of a cluster where every later `ray.init()` of the machine looks, and fails without that folder."""
    note = Path(get_ray_address_file(None))
    noted = note.read_text() if note.exists() else None
    before = set(os.listdir("/proc"))
    with simulated_nodes(2):
        during = {pid for pid in set(os.listdir("/proc")) - before if pid.isdigit() and b"raylet" in command_of(pid)}
        assert len(during) >= 3 and (note.read_text() if note.exists() else None) == noted
    assert not [pid for pid in during if b"raylet" in command_of(pid)]
    (lap,) = measure_simulated(JOB, tmp_path, [2], [0.4])
    assert lap["nodes"] == 2 and lap["overhead"] > 0.0 and 0.0 < lap["shards_per_s"] <= 2 / 0.4
    assert lap["coordinator_ms"] > 0.0 and "start_s" in lap


# ---------------------------------------------------------------------------------------------- the extra `study`


def test_without_the_extra_both_commands_end_with_one_message_before_anything_is_made(monkeypatch, tmp_path, capsys):
    require_extra("bench")
    for package in PACKAGES:
        monkeypatch.setattr(command, "find_spec", lambda name, package=package: None if name == package else object())
        with pytest.raises(MachineError, match=rf"needs {PACKAGES[package]}: .*extra study.*requirements-study\.lock"):
            require_extra("tradeoff")
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    monkeypatch.chdir(tmp_path)
    for words in (["bench"], ["tradeoff", str(ROOT / "deploy" / "jobs" / "tabletop.yaml"), "--out", "OUT"]):
        assert main([*words, "--json"]) == 1
        told = capsys.readouterr()
        assert told.err.count("\n") == 1 and "./verso extra study" in told.err
        assert json.loads(told.out)["kind"] == "MachineError" and list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------------------------------- captures


def test_the_script_finds_the_poses_of_drawn_photographs_in_the_frame_of_the_board(tmp_path):
    rng = np.random.default_rng(7)
    board = Board(columns=5, rows=4, first_id=3, width_m=0.5, ruler_m=0.1, measured_ruler_m=0.1)
    true = hand_held(rng, 2)
    for number, T in enumerate(true):
        write_view(tmp_path, CapturedView(number, photograph(board, T, KINECT, rng), None, None))
    write_description(tmp_path, CaptureFile(name="drawn"), CaptureCamera(KINECT, np.zeros(8)), board)
    for refinement, most_mm in (("default", 3.0), ("SUBPIX", 2.0)):
        poses = marker_script.estimate_poses(marker_script.read_photographs(tmp_path), refinement)
        assert max(errors(poses[number], T)[0] for number, T in enumerate(true)) < most_mm
        assert max(errors(poses[number], T)[1] for number, T in enumerate(true)) < 0.2
    scaled = board.model_copy(update={"measured_ruler_m": 0.101})  # a print 1 % larger is as much farther away
    write_description(tmp_path, CaptureFile(name="drawn"), CaptureCamera(KINECT, np.zeros(8)), scaled)
    larger = marker_script.estimate_poses(marker_script.read_photographs(tmp_path), "SUBPIX")
    assert np.allclose(larger[0][:3, 3], 1.01 * poses[0][:3, 3], atol=1e-6)


def side_of(pose_mm, pose_deg=0.01, missing=0):
    return {"pose_mm": pose_mm, "pose_deg": pose_deg, "missing": missing, "cloud": None, "seconds": 1.0}


def test_the_stronger_script_is_the_rival_and_captures_miss_their_bar_by_the_median_or_by_one_that_is_worse():
    def rows(*ours):
        weak, strong = side_of(9.0), side_of(1.0, 0.02)
        return [{"object": "mug", "ours": one, "default": weak, "SUBPIX": strong} for one in ours]

    good = captures.summarise(rows(side_of(0.1), side_of(0.2), side_of(0.9)))
    assert (good["rival"], good["ratio"], good["ratio_deg"], good["ok"]) == ("SUBPIX", 5.0, 2.0, True)
    assert not captures.summarise(rows(side_of(0.1), side_of(0.21), side_of(0.9)))["ok"]
    for worse in (side_of(1.1), side_of(0.1, 0.03)):
        told = captures.summarise(rows(side_of(0.1), side_of(0.1), worse))
        assert not told["ok"] and told["worse"] == [2]
    figures = {
        **told,
        "machine": {"cpu": "x", "load_1min": 0.0},
        "command": "verso",
        "off": ["print_scale"],
        "views": 3,
    }
    text = "\n".join(captures.describe(figures))
    assert "below 1: mug" in text and "open3d" in text and "all effects but print_scale" in text


def test_a_view_without_a_pose_counts_as_lost_and_points_by_their_distance_to_the_surface():
    square = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    shifted = np.eye(4)
    shifted[0, 3] = 0.002
    true = {n: np.eye(4) for n in range(3)}
    points = np.array([[0.3, 0.2, 0.001], [0.6, 0.7, -0.003], [0.5, 0.5, 0.002]])
    found = captures.errors_of({0: shifted, 2: np.eye(4)}, points, 1.0, true, square)
    assert found["pose_mm"] == pytest.approx(2.0) and found["missing"] == 1
    assert found["cloud"]["median_mm"] == pytest.approx(2.0) and found["cloud"]["points"] == 3
    lost = captures.errors_of({0: shifted}, None, 1.0, true, square)
    assert lost["pose_mm"] == captures.NO_POSE_MM and lost["cloud"] is None


@pytest.mark.minute
def test_captures_are_compared_by_a_command_whose_code_says_whether_they_keep_their_bar(tmp_path, capsys):
    small = ["captures.simulate.views=4", "captures.simulate.image_scale=0.4", "categories=[can]"]
    words = [word for change in small for word in ("--set", change)]
    code = main(["bench", "captures", "--scenes", "1", "--folder", str(tmp_path), "--json", *words])
    *text, last = capsys.readouterr().out.splitlines()
    told = json.loads(last)
    (row,) = told["captures"]
    assert code == (0 if told["ok"] else 1) and told["views"] == 4 and set(told["off"]) == set(captures.LEFT_OUT)
    assert 0 < row["ours"]["pose_mm"] < 10 and row["ratio"] == row["rival"]["pose_mm"] / row["ours"]["pose_mm"]
    assert any(line.startswith("median ratio") for line in text) and not list(tmp_path.iterdir())
