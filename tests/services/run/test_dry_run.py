"""A dry run refuses what a run would, tells what is there and what the rest costs, and changes nothing."""

import importlib.util
import json
import os
import re
from pathlib import Path

import pytest

from schemas.errors import OutputError, VersoError
from schemas.job.job import Job
from services.cli.main import main
from services.job.record import encode_job, record_job
from services.run import dry_run
from services.run.dry_run import describe_plan, measure_scene
from services.run.run_job import RunRequest, open_inputs

SMALL = {"cameras": {"sensor": {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0}}}


def request(out: Path, **keys) -> RunRequest:
    return RunRequest(Job.model_validate({"name": "t", "scenes": 4, **SMALL, **keys}), Path(), str(out))


@pytest.fixture
def timed(monkeypatch):
    monkeypatch.setattr(dry_run, "measure_scene", lambda job, catalogue: (0.5, 2e6))
    monkeypatch.setattr(dry_run, "usable_cores", lambda: 2)


@pytest.mark.usefixtures("timed")
def test_what_is_left_and_its_cost_are_told_and_nothing_is_made(tmp_path):
    lines = describe_plan(request(tmp_path / "new"))
    assert lines[0] == "job t: scenes 0 to 3, 1 pair each, seed 0"
    assert lines[-2] == "0 of 4 scenes are there, 4 are left to make"
    assert "about 2 s of processor, 1 s with 2 workers here, and 8 MB (500 ms and 2.00 MB a scene" in lines[-1]
    assert not (tmp_path / "new").exists()


def test_a_scene_is_measured_by_making_it():
    asked = request(Path("nowhere"))
    seconds, size = measure_scene(asked.job, open_inputs(asked)[0])
    assert 0.005 < seconds < 5.0
    assert 5e3 < size < 5e5  # some twelve pictures of 64 x 48


@pytest.mark.usefixtures("timed")
def test_another_jobs_folder_and_somebodys_files_are_refused_as_a_run_refuses_them(tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "thesis.txt").write_text("years")
    with pytest.raises(OutputError, match=r"holds thesis\.txt, and no job\.yaml"):
        describe_plan(request(tmp_path / "theirs"))
    asked = request(tmp_path)
    (tmp_path / "job.yaml").write_bytes(
        encode_job(record_job(asked.job, open_inputs(asked)[0].digest, asked.job_folder))
    )
    assert "4 are left" in describe_plan(asked)[-2]
    with pytest.raises(VersoError, match=re.escape("start.pose: upright there, tumbled here")):
        describe_plan(request(tmp_path, start={"pose": "tumbled"}))


@pytest.mark.usefixtures("timed")
def test_a_place_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        describe_plan(request(tmp_path / "file" / "out"))
    monkeypatch.setattr(os, "access", lambda place, mode: False)
    with pytest.raises(OutputError, match="cannot be written: choose another --out"):
        describe_plan(request(tmp_path / "out"))


@pytest.mark.parametrize("more", [[], ["--dry-run"]])
def test_a_tier_that_is_not_installed_is_refused_before_anything_is_made(tmp_path, monkeypatch, capsys, more):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "mitsuba" else find_spec(name, *a)
    )
    job, out = tmp_path / "job.yaml", tmp_path / "out"
    job.write_text(json.dumps({"name": "t", "scenes": 1, "render": {"tier": "pathtraced"}}))
    assert main(["run", str(job), "--out", str(out), *more]) == 2
    told = capsys.readouterr().err
    assert "Mitsuba is not installed" in told and "./verso extra pathtraced" in told
    assert not Path(out).exists()


@pytest.mark.parametrize(("key", "value"), [("path_samples", 0), ("path_samples", "many"), ("path_bounces", 65)])
def test_a_count_of_paths_that_cannot_be_is_told_by_its_key(tmp_path, capsys, key, value):
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps({"name": "t", "render": {"tier": "pathtraced", key: value}}))
    assert main(["run", str(job), "--dry-run"]) == 2
    assert f"render.{key}: {value!r}" in capsys.readouterr().err


def test_a_tier_whose_system_library_is_missing_is_refused_with_the_package(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed: ./verso extra pathtraced")
    monkeypatch.setattr("workers.render.tiers.SYSTEM_LIBRARY", "libnone-of-this-name.so.1")
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps({"name": "t", "scenes": 1, "render": {"tier": "pathtraced"}}))
    assert main(["run", str(job), "--out", str(tmp_path / "out")]) == 2
    assert "apt-get install -y libatomic1" in capsys.readouterr().err
