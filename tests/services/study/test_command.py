"""`verso tradeoff` from the command line to the page: small, stopped and gone on with, and asked for what cannot be; and the
study of a job of captures."""

import json
from contextlib import closing
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

from schemas.capture import CaptureScore
from schemas.errors import InputError, MachineError
from schemas.job.job import Job
from services.cli.main import main
from services.run.progress import ProgressLine
from services.study import command, study
from services.study.command import check_captures, errors_of, fewer_views, measure_capture, rows_of, run_capture_study
from services.study.model import Plan, Setting, Sizes
from services.study.study import JOURNAL_FILE, Journal
from tests.services.cli.test_commands import TABLETOP, told
from tests.services.study.made_up import read_study
from workers.assets.catalogue import open_catalogue
from workers.capture.folder import open_folder
from workers.capture.make_capture import simulate_one
from workers.scene.context import open_worker

SMALL = [
    *("--scenes", "4", "--physics-scenes", "1", "--laps", "1", "--workers", "1", "--knobs", "exact_rest,units"),
    *("--set", "cameras.sensor={width: 160, height: 120, fx: 131.25, fy: 131.25, cx: 80, cy: 60}"),
]


@pytest.fixture(scope="module", autouse=True)
def one_coloured_scene():
    """The truth of a scene's colour takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "Sizes", partial(Sizes, coloured=1))
        yield


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    """A small study, stopped half way and gone on with."""
    out = tmp_path_factory.mktemp("study")
    real, calls = study.time_scene, []

    def stopped(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "time_scene", stopped)
        assert main(["tradeoff", TABLETOP, "--out", str(out), *SMALL]) == 1
    kept = (out / JOURNAL_FILE).read_text()
    assert len(kept.splitlines()) == 1 + 2 and not (out / "tradeoff.parquet").exists()
    assert main(["tradeoff", TABLETOP, "--out", str(out), *SMALL]) == 0
    assert (out / JOURNAL_FILE).read_text().startswith(kept)
    return out


@pytest.mark.minute
def test_a_study_has_every_setting_with_its_errors_its_plots_and_its_page(measured):
    """99 % of even rounding errors are within 0.99 of half a unit: 0.1 mm, 0.5 mm and 0.0625 mm."""
    rows = {row["setting"]: row for row in pq.read_table(measured / "tradeoff.parquet").to_pylist()}
    assert {"the job", "exact_rest=off", "units=1000", "units=8000"} <= set(rows)
    assert rows["the job"]["ratio"] == 1.0 and all(row["ms"] > 0 for row in rows.values())
    assert rows["the job"]["penetration_mm"] < 1e-9 <= rows["exact_rest=off"]["penetration_mm"]
    for name, off_mm in (("the job", 0.1), ("units=1000", 0.5), ("units=8000", 0.0625)):
        assert rows[name]["depth_mm"] == pytest.approx(off_mm, rel=0.05)
    page = (measured / "index.html").read_text()
    assert "<html" in page and "units" in page and "1000" in page
    for name in ("tradeoff.png", "knob_units.png"):
        assert (measured / name).stat().st_size > 10_000


@pytest.mark.minute
def test_the_same_command_measures_nothing_twice_and_says_the_same(measured, capsys):
    before, rows = (measured / JOURNAL_FILE).read_bytes(), read_study(measured).rows
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL)
    assert code == 0 and "convergence" in text
    assert (measured / JOURNAL_FILE).read_bytes() == before and read_study(measured).rows == rows
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--target", "depth_mm=0.01")
    assert code == 1 and "units=8000" in text and "depth_mm" in text and "0.06" in text
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--set", "seed=5")
    assert code == 2 and "another study" in text and "--out" in text


@pytest.mark.minute
def test_a_target_writes_the_job_with_the_cheapest_setting_that_meets_it(measured, capsys):
    assert main(["tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--target", "depth_mm=0.3", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    tree = yaml.safe_load((measured / "job.yaml").read_text())
    assert tree["name"] == "tabletop" and tree["cameras"]["sensor"]["width"] == 160
    for key, value in answer["changes"].items():
        assert reduce(lambda place, part: place[part], key.split("."), tree) == value
    assert main(["run", str(measured / "job.yaml"), "--dry-run"]) == 0


def test_bad_input_is_told_by_its_value_and_remedy_before_anything_is_measured(tmp_path, capsys, monkeypatch):
    for arguments, words in (
        (["--knobs", "stepp"], ["stepp", "did you mean 'step'"]),
        (["--target", "depth=0.1"], ["depth", "depth_mm"]),
        (["--target", "depth_mm=near"], ["near"]),
        (["--target", "depth_mm=-1"], ["-1"]),
        (["--scenes", "1"], ["1 scene", "--scenes"]),
        (["--set", "scenes=1"], ["1 scene", "scenes: 1"]),
        (["--set", "physics.step_hz=1"], ["physics.step_hz"]),
    ):
        code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(tmp_path / "out"), *arguments)
        assert code == 2 and [word for word in words if word not in text] == []

    def missing(*_: object) -> None:
        raise MachineError("`./verso extra pathtraced` installs it")

    monkeypatch.setattr(command, "require_tier", missing)
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(tmp_path / "out"), "--set", "render.tier=pathtraced")
    assert code == 1 and "./verso extra pathtraced" in text and not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------------------------- captures

OWN, COARSE = Setting(), Setting((("voxel", "0.008"),), {"captures.fusion.voxel_m": 0.008})
HOPELESS = Setting((("views", "1"),), {"captures.simulate.views": 1})

SMALL_CAPTURE = {
    "simulate": {"views": 6, "image_scale": 0.3},
    "estimation": {"compare": False},
    "fusion": {"voxel_m": 0.003},
}


def plan(captures: dict, count: int = 2) -> Plan:
    job = Job.model_validate({"name": "t", "scenes": count, "categories": ["mug"], "captures": captures})
    return Plan(job, Path(), (), (OWN, COARSE, HOPELESS), (), None, Sizes(scenes=count, settled=0, laps=2))


def answer(own_s: float, coarse_s: float) -> dict:
    """Of a capture that cannot be processed with `HOPELESS`."""
    return {
        "whole": {OWN.name: own_s, COARSE.name: coarse_s},
        "settling": {},
        "bytes": {OWN.name: 2000, COARSE.name: 500},
        "errors": {OWN.name: {"cloud_mm": 0.2}, COARSE.name: {"cloud_mm": 0.8}},
        "failed": {HOPELESS.name: "poses: too few views"},
        "cold": own_s,
    }


@pytest.mark.minute
def test_a_setting_has_its_time_its_bytes_and_its_errors_or_a_reason(tmp_path):
    made = plan(SMALL_CAPTURE)
    context = open_worker(made.job, open_catalogue(made.job.assets, Path(), tuple(made.job.categories)))
    simulate_one(context, 0, tmp_path / "capture")
    found = measure_capture(context, made.settings, tmp_path / "capture", (0, 0))
    assert set(found["whole"]) == {OWN.name, COARSE.name} and all(s > 0 for s in found["whole"].values())
    assert found["bytes"][COARSE.name] < found["bytes"][OWN.name] / 3
    assert found["errors"][OWN.name]["cloud_mm"] < found["errors"][COARSE.name]["cloud_mm"]
    assert "views" in found["failed"][HOPELESS.name]
    folder = open_folder(tmp_path / "capture")
    assert fewer_views(folder, 3).numbers == (0, 2, 5) and fewer_views(folder, 99).numbers == folder.numbers


def test_a_row_has_the_ratio_of_times_over_captures_the_worst_errors_and_why_some_failed():
    laps = [{0: answer(4.0, 1.0), 1: answer(8.0, 2.0)}] * 2
    own, coarse = rows_of(plan({}), laps)
    assert (own.ratio, own.ms, own.kilobytes) == (1.0, 6000.0, 2.0)
    assert (coarse.ratio, coarse.ms, coarse.kilobytes) == (0.25, 1500.0, 0.5)
    assert coarse.errors["cloud_mm"].value == 0.8
    first = answer(4.0, 1.0) | {"failed": {COARSE.name: "fuse: nothing is seen"}}
    del first["whole"][COARSE.name], first["errors"][COARSE.name], first["bytes"][COARSE.name]
    coarse = rows_of(plan({}), [{0: first, 1: answer(8.0, 2.0)}] * 2)[1]
    assert coarse.failed_share == 0.5 and coarse.notes == ("fuse: nothing is seen",)
    scored = errors_of(CaptureScore(pose_mm=0.5, completeness=0.98))  # what was not scored is left out
    assert scored == {"camera_mm": 0.5, "missing_share": pytest.approx(0.02)}


def test_a_study_of_captures_warms_up_once_and_measures_what_its_journal_lacks(monkeypatch, tmp_path):
    done: list[tuple] = []

    def measure(context, settings, path, unit):
        done.append(("measure", *unit))
        return answer(4.0, 1.0)

    monkeypatch.setattr(command, "simulate_one", lambda context, scene, path: done.append(("simulate", scene)))
    monkeypatch.setattr(command, "warm_up", lambda context, setting, path: done.append(("warm", setting.name)))
    monkeypatch.setattr(command, "measure_capture", measure)
    with Journal(tmp_path, {}) as journal, closing(ProgressLine(0, "test", unit="measurement")) as progress:
        journal.add("captures/0/0", answer(4.0, 1.0))
        rows = run_capture_study(plan({}, count=3), journal, None, progress)
        assert [row.setting for row in rows] == [OWN, COARSE]
        assert done[:3] == [("simulate", 0), ("warm", OWN.name), ("measure", 0, 1)]
        later = [[("simulate", n), ("measure", n, 0), ("measure", n, 1)] for n in (1, 2)]
        assert done[3:] == [*later[0], *later[1]]
        done.clear()
        assert run_capture_study(plan({}, count=3), journal, None, progress) == rows and done == []


def test_captures_without_truth_and_a_single_capture_are_refused():
    with pytest.raises(InputError, match=r"captures\.source"):
        check_captures(plan({"source": "folders", "folders": ["a", "b"]}))
    with pytest.raises(InputError, match="1 capture cannot tell"):
        check_captures(replace(plan({}), sizes=Sizes(scenes=1)))
