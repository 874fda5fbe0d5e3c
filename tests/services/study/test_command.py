"""`verso tradeoff` from the command line to the page: small, stopped and gone on with, asked for what cannot be."""

import json
import re
from functools import reduce
from pathlib import Path
from types import SimpleNamespace

import pyarrow.parquet as pq
import pytest
import yaml

from schemas.errors import InputError, MachineError
from schemas.job.job import Job
from services.cli.main import main
from services.job.job_file import load_job
from services.study import command
from services.study.command import refuse_unmeasured
from services.study.measure import RESTS, measure_capture
from services.study.model import Setting
from services.study.study import HEADER, JOURNAL_FILE, SPENT, Journal, Unit, answer_unit
from tests.services.cli.test_commands import TABLETOP, told
from tests.services.study.made_up import read_study
from workers.assets.catalogue import open_catalogue
from workers.pool import run_pool
from workers.scene.context import open_worker

SMALL = [
    *("--budget", "60s", "--workers", "1", "--knobs", "exact_rest,units", "--target", "depth_mm=0.11"),
    *("--set", "cameras.sensor={width: 160, height: 120, fx: 131.25, fy: 131.25, cx: 80, cy: 60}"),
]


def unit_of(job: Job, part: str, scene_id: int, scratch: Path) -> Unit:
    where = job.model_dump_json(), str(Path(TABLETOP).parent), str(scratch)
    return Unit(*where, part, scene_id, (Setting(),))


def units_of(folder: Path) -> list[str]:
    """The keys of answers, in their order, each as often as it was kept."""
    lines = (folder / JOURNAL_FILE).read_bytes().split(b"\n@")[1:]
    keys = [line.partition(b"\n")[0].split(b" ", 2)[2].decode() for line in lines]
    return [key for key in keys if key not in (HEADER, SPENT)]


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    """A small study, stopped after two answers and gone on with.

    One scene comes first: the first on a machine compiles for longer than the small study may take.
    """
    out = tmp_path_factory.mktemp("study")
    job = load_job(Path(TABLETOP), SMALL[-1:])
    assert len(list(run_pool(answer_unit, [unit_of(job, part, 0, out) for part in ("rest", "draw")]))) == 2
    real, calls = Journal.add, []

    def stopped(journal, *entry):
        calls.append(entry)
        if len(calls) == 4:
            raise KeyboardInterrupt
        real(journal, *entry)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journal, "add", stopped)
        assert main(["tradeoff", TABLETOP, "--out", str(out), *SMALL]) == 1
    kept = (out / JOURNAL_FILE).read_bytes()
    assert len(units_of(out)) == 2 and not (out / "tradeoff.parquet").exists()
    assert main(["tradeoff", TABLETOP, "--out", str(out), *SMALL]) == 0
    assert (out / JOURNAL_FILE).read_bytes().startswith(kept)
    return out


@pytest.mark.minute
def test_a_study_has_every_setting_with_its_errors_its_plots_its_proof_and_its_page(measured):
    """99 % of even rounding errors are within 0.99 of half a unit: 0.1 mm, 0.5 mm and 0.0625 mm."""
    rows = {row["setting"]: row for row in pq.read_table(measured / "tradeoff.parquet").to_pylist()}
    assert {"the job", "exact_rest=off", "units=1000", "units=8000"} <= set(rows)
    assert rows["the job"]["ratio"] == 1.0 and all(row["ms"] > 0 for row in rows.values())
    assert rows["the job"]["penetration_mm"] < 1e-9 <= rows["exact_rest=off"]["penetration_mm"]
    for name, off_mm in (("the job", 0.1), ("units=1000", 0.5), ("units=8000", 0.0625)):
        assert rows[name]["depth_mm"] == pytest.approx(off_mm, rel=0.05)
    study = read_study(measured)
    assert study.chosen in rows and study.proofs[-1].setting == study.chosen and study.proofs[-1].holds
    assert study.proofs[-1].scenes >= 4 and study.seconds < 1.1 * study.budget_s == pytest.approx(66.0)
    page = (measured / "index.html").read_text()
    assert "<html" in page and "units" in page and "1000" in page and "fresh scenes" in page
    assert (measured / "tradeoff.png").stat().st_size > 10_000


@pytest.mark.minute
def test_the_same_command_measures_nothing_twice_and_a_longer_budget_goes_on(measured, capsys):
    before = units_of(measured)
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--target", "depth_mm=0.01")
    assert code == 1 and "units=8000" in text and "depth_mm" in text and "0.06" in text
    assert len(set(before)) == len(before)
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--budget", "66s")
    after = units_of(measured)
    assert code == 0 and after[: len(before)] == before and len(set(after)) == len(after)
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--set", "seed=5")
    assert code == 2 and "another study" in text and "--out" in text


@pytest.mark.slow
def test_a_target_writes_the_job_with_the_cheapest_setting_that_meets_it(measured, capsys):
    words = ["--target", "depth_mm=0.3,kept_share=0.9", "--budget", "76s", "--json"]
    assert main(["tradeoff", TABLETOP, "--out", str(measured), *SMALL, *words]) == 0
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
        (["--target", "kept_share=2"], ["kept_share=2", "from 0 up"]),
        (["--target", "cloud_mm=1"], ["cloud_mm", "no captures"]),
        (["--target", "pose_mm=1", "--set", "start.pose=tumbled"], ["pose_mm", "outcome_mm"]),
        (["--budget", "quick"], ["quick", "15m"]),
        (["--budget", "0s"], ["0s", "15m"]),
        (["--set", "physics.step_hz=1"], ["physics.step_hz"]),
    ):
        code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(tmp_path / "out"), *arguments)
        assert code == 2 and [word for word in words if word not in text] == [], arguments

    def missing(*_: object) -> None:
        raise MachineError("`./verso extra pathtraced` installs it")

    monkeypatch.setattr(command, "require_tier", missing)
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(tmp_path / "out"), "--set", "render.tier=pathtraced")
    assert code == 1 and "./verso extra pathtraced" in text and not (tmp_path / "out").exists()


@pytest.mark.minute
def test_a_job_of_which_nothing_can_be_made_and_a_budget_that_is_too_short_are_named_at_once(tmp_path, capsys):
    off = ["--budget", "40s", "--set", "start.offset_m=[50, 60]"]
    for options, words in (
        (off, ["none of the job's first 4 scenes", "no_table_below"]),
        (["--budget", "1s"], ["took more than", "--budget"]),
    ):
        out = str(tmp_path / options[1])
        code, text = told(capsys, "tradeoff", TABLETOP, "--out", out, "--workers", "1", *options)
        assert code == 1 and [word for word in words if word not in text] == []


@pytest.mark.minute
def test_files_from_outside_are_read_by_processes_of_their_own_also_in_a_study(tmp_path):
    job = load_job(Path(TABLETOP).with_name("real_meshes.yaml"), [])
    units = [unit_of(job, "rest", scene, tmp_path) for scene in range(4)]
    answers = [json.loads(answer)["the job"] for _, answer in run_pool(answer_unit, units, processes=1)]
    assert not [each["broken"] for each in answers if "broken" in each] and any("errors" in each for each in answers)


OWN, COARSE = Setting(), Setting((("voxel", "0.008"),), {"captures.fusion.voxel_m": 0.008})
MERGED = Setting((("merged_views", "1"),), {"captures.synthesis.views": 1})
HOPELESS = Setting((("views", "1"),), {"captures.simulate.views": 1})

SMALL_CAPTURE = {"simulate": {"views": 6, "image_scale": 0.3}, "estimation": {"compare": False}} | {
    "fusion": {"voxel_m": 0.003}
}


def job_of(captures: dict) -> Job:
    return Job.model_validate({"name": "t", "scenes": 2, "categories": ["mug"], "captures": captures})


@pytest.mark.minute
def test_a_setting_has_its_time_its_bytes_and_its_errors_or_a_reason(tmp_path, monkeypatch):
    monkeypatch.setitem(RESTS, "folder", tmp_path)
    job = job_of(SMALL_CAPTURE)
    context = open_worker(job, open_catalogue(job.assets, Path(), tuple(job.categories)))
    answers = measure_capture(context, (OWN, COARSE, MERGED, HOPELESS), 0)
    assert all(answers[each.name]["s"] > 0 for each in (OWN, COARSE)) and "failed" in answers[HOPELESS.name]
    assert answers[MERGED.name]["s"] < 0.9 * answers[OWN.name]["s"]  # every photograph has a view from the other side
    assert answers[COARSE.name]["bytes"] < answers[OWN.name]["bytes"] / 3
    assert answers[OWN.name]["errors"]["cloud_mm"] < answers[COARSE.name]["errors"]["cloud_mm"]


def test_captures_without_truth_and_targets_that_a_job_cannot_have_are_refused():
    options = SimpleNamespace(knobs=None, workers=1, job=Path("job.yaml"), budget=60.0)
    with pytest.raises(InputError, match=r"captures\.folders"):
        command.make_plan(job_of({"folders": ["a", "b"]}), options, None)
    with pytest.raises(InputError, match="scene is studio"):
        command.make_plan(Job(name="t", scene="studio"), options, None)
    with pytest.raises(InputError, match="the job is one of captures"):
        refuse_unmeasured(job_of({}), {"depth_mm": 0.1}, None)
    with pytest.raises(InputError, match=r"extra pathtraced"):
        refuse_unmeasured(Job(name="t"), {"flip": 0.1}, "`./verso extra pathtraced`")
    refuse_unmeasured(Job(name="t"), {"edge_flip": 0.1, "pose_mm": 0.1}, None)


def test_without_the_extra_the_command_ends_with_one_message_before_anything_is_made(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["tradeoff", TABLETOP, "--out", "OUT", "--json"]
    for module, package in command.PACKAGES.items():
        monkeypatch.setattr(command, "find_spec", lambda name, module=module: None if name == module else object())
        assert main(words) == 1
        printed = capsys.readouterr()
        assert re.fullmatch(rf"[^\n]*needs {package}: .*extra study.*requirements-study\.lock[^\n]*\n", printed.err)
        assert json.loads(printed.out)["kind"] == "MachineError" and list(tmp_path.iterdir()) == []
