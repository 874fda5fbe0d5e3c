"""What a run tells: a dry run before it, lines and events and metrics while it works."""

import importlib.util
import json
import logging
import os
import re
import subprocess
import sys
import urllib.error
from collections import Counter
from pathlib import Path
from unittest.mock import Mock

import pytest

from schemas.base import set_key
from schemas.dataset.layout import LOG_FOLDER
from schemas.errors import MachineError, OutputError, SettleError, VersoError
from schemas.job.job import Job
from services.cli.main import main
from services.job.record import encode_job, record_job
from services.run import progress as module
from services.run import run_job
from services.run.progress import Meter, ProgressLine, Tally, event_log, log_event, serve
from services.run.run_job import RunRequest, describe_plan, measure_scene, open_inputs
from tests.kit.network import free_port
from tests.services.run.scraped import scrape
from workers.shard.framing import require_framed

ROOT = Path(__file__).resolve().parents[3]
SMALL = {"cameras": {"sensor": {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0}}}


def request(out: Path, **keys) -> RunRequest:
    return RunRequest(Job.model_validate({"name": "t", "scenes": 4, **SMALL, **keys}), Path(), str(out))


@pytest.fixture
def timed(monkeypatch):
    monkeypatch.setattr(run_job, "measure_scene", lambda job, catalogue: (0.5, 2e6))
    monkeypatch.setattr(run_job, "usable_cores", lambda: 2)


@pytest.mark.usefixtures("timed")
def test_what_is_left_and_its_cost_are_told_and_nothing_is_made(tmp_path):
    lines = describe_plan(request(tmp_path / "new"))
    assert lines[0] == "job t: scenes 0 to 3, 1 pair each, seed 0"
    assert lines[-2] == "0 of 4 scenes are there, 4 are left to make"
    assert "about 2 s of processor, 1 s with 2 workers here, and 8 MB (500 ms and 2.00 MB a scene" in lines[-1]
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"cameras.orbit.radius_m": 125},
            r"input camera has the object 12\d to 12\d m before .* change cameras\.orbit",
        ),
        (
            {"cameras.orbit.radius_m": 0.05},
            r"m across, and the input camera stands 0\.\d+ m from its middle: set cameras\.orbit\.radius_m: fit",
        ),
        (
            {"images.depth_range_m": [3, 4]},
            r"object 2\.\d+ to 2\.\d+ m before it, outside images\.depth_range_m \[3, 4\]",
        ),
        ({"cameras.mirror.T_z_m": 60}, r"mirror camera has the object (59\.\d|60) to .* change cameras\.mirror\.T_z_m"),
        ({"cameras.sensor.cx": -5000}, r"beside its picture or smaller than a pixel: see cameras\.sensor"),
        (
            {"cameras.orbit.radius_m": "fit", "cameras.mirror.T_z_m": "fit", "images.depth_range_m": [3.0, 3.05]},
            r"m across together: the camera that frames them .* 3 to 3\.05 m",
        ),
        (
            {
                "scene": "studio",
                "studio.scale": "metric",
                "images.depth_range_m": [0.8, 8.0],
                "cameras.more": [{"name": "a", "preset": "trellis"}],
            },
            r"camera a, number 0, has the objects 0\.\d+ to 0\.\d+ m before it, .* 0\.8 to 8 m: widen images.* or set studio",
        ),
        (
            {"sensor.depth_noise.range_m": [0.5, 1.5]},
            r"the input camera .* outside sensor\.depth_noise\.range_m \[0\.5, 1\.5\]: change cameras\.orbit\.radius_m",
        ),
        ({"start.offset_m": [3, 4]}, r"none of 21 positions .* narrow start\.offset_m"),
    ],
)
def test_a_job_whose_scenes_cannot_be_framed_is_refused_before_anything_is_written(keys, message, tmp_path, capsys):
    job, out = tmp_path / "job.yaml", tmp_path / "out"
    tree = {"name": "t", "scenes": 3}
    for key, value in keys.items():
        set_key(tree, key, value)
    job.write_text(json.dumps(tree))
    assert main(["run", str(job), "--out", str(out), "--dry-run"]) == 2
    assert re.search(
        f"job t: none of the first 3 scenes can be planned and framed: .*{message}", capsys.readouterr().err
    )
    assert not out.exists()


@pytest.mark.minute
def test_a_run_is_refused_by_its_first_worker_and_leaves_its_folder_as_it_was(tmp_path, capsys):
    job, out = tmp_path / "job.yaml", tmp_path / "out"
    job.write_text(json.dumps({"name": "t", "scenes": 3, "cameras": {"orbit": {"radius_m": 125}}}))
    assert main(["run", str(job), "--out", str(out), "--address", "127.0.0.1:1"]) == 1  # nobody answers there
    assert main(["run", str(job), "--out", str(out)]) == 2
    assert "change cameras.orbit.radius_m, which is 125" in capsys.readouterr().err
    assert not out.exists()
    out.mkdir()
    assert main(["run", str(job), "--out", str(out)]) == 2
    assert not list(out.iterdir())


def test_cameras_that_frame_their_objects_are_asked_where_they_will_stand(tmp_path):
    """Before a scene is at rest they stand at a distance that stands for one."""
    framed = {"orbit": {"radius_m": "fit"}, "mirror": {"T_z_m": "fit"}}
    asked = request(tmp_path / "new", cameras=framed, images={"depth_range_m": [1.3, 3.0]})
    require_framed(asked.job, open_inputs(asked.job, asked.job_folder, asked.out)[0])


def test_a_dry_run_says_why_scenes_cannot_be_made_that_can_be_framed(tmp_path, monkeypatch):
    monkeypatch.setattr("workers.shard.run_shard.make_scene", Mock(side_effect=SettleError("not_at_rest", "it rolls")))
    last = describe_plan(request(tmp_path / "new"))[-1]
    assert last.endswith("the first scenes cannot be made: not_at_rest: it rolls")


def test_a_scene_is_measured_by_making_it():
    asked = request(Path("nowhere"))
    seconds, size = measure_scene(asked.job, open_inputs(asked.job, asked.job_folder, asked.out)[0])
    assert 0.005 < seconds < 5.0
    assert 5e3 < size < 5e5  # some twelve pictures of 64 x 48


@pytest.mark.usefixtures("timed")
def test_another_jobs_folder_somebodys_files_and_a_place_that_cannot_be_written_are_refused(tmp_path, monkeypatch):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "thesis.txt").write_text("years")
    (tmp_path / "file").write_text("")
    asked, out = request(tmp_path / "out"), tmp_path / "out"
    out.mkdir()
    record = record_job(asked.job, open_inputs(asked.job, asked.job_folder, asked.out)[0].digest, asked.job_folder)
    (out / "job.yaml").write_bytes(encode_job(record))
    assert "4 are left" in describe_plan(asked)[-2]
    refusals = [
        (request(tmp_path / "theirs"), OutputError, r"holds thesis\.txt, and no job\.yaml"),
        (request(out, start={"pose": "tumbled"}), VersoError, re.escape("start.pose: upright there, tumbled here")),
        (request(tmp_path / "file" / "out"), OutputError, "cannot be written"),
    ]
    for refused, error, words in refusals:
        with pytest.raises(error, match=words):
            describe_plan(refused)
    monkeypatch.setattr(os, "access", lambda place, mode: False)
    with pytest.raises(OutputError, match="cannot be written: choose another --out"):
        describe_plan(request(tmp_path / "new"))


def test_a_tier_that_cannot_draw_here_is_refused_with_the_remedy_before_anything_is_made(tmp_path, monkeypatch, capsys):
    job, out = tmp_path / "job.yaml", tmp_path / "out"

    def refusal(render: dict, *more: str) -> str:
        job.write_text(json.dumps({"name": "t", "scenes": 1, "render": {"tier": "pathtraced", **render}}))
        assert main(["run", str(job), "--out", str(out), *more]) == 2
        assert not out.exists()
        return capsys.readouterr().err

    for key, value in (("path_samples", 0), ("path_samples", "many"), ("path_bounces", 65)):
        assert f"render.{key}: {value!r}" in refusal({key: value}, "--dry-run")
    if importlib.util.find_spec("mitsuba"):
        with monkeypatch.context() as patch:
            patch.setattr("workers.render.tiers.SYSTEM_LIBRARY", "libnone-of-this-name.so.1")
            assert "apt-get install -y libatomic1" in refusal({})
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "mitsuba" else find(name, *a))
    for more in ([], ["--dry-run"]):
        said = refusal({}, *more)
        assert "Mitsuba is not installed" in said and "./verso extra pathtraced" in said


# ------------------------------------------------------------------------------------------------ lines and events


def test_events_are_json_lines_in_the_log_while_it_is_open(tmp_path):
    with event_log(tmp_path):
        log_event("worker lost", logging.WARNING, scene=3)
    log_event("too late")
    with event_log(None):
        log_event("nowhere")
    (line,) = (tmp_path / LOG_FOLDER / "verso.jsonl").read_text().splitlines()
    event = json.loads(line)
    assert (event["level"], event["event"], event["scene"]) == ("warning", "worker lost", 3)


def test_a_log_has_a_few_lines_soon_and_then_one_a_minute(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    line = ProgressLine(20, "mugs")
    shown = [(101, 0), (104, 0), (105, 1), (120, 2), (140, 4), (170, 5), (219, 9), (222, 20)]
    for now[0], done in shown:
        line.show(done, failed=1)
    line.close()
    assert capsys.readouterr().err.splitlines() == [
        "mugs: 0 of 20 scenes, 1 failed",
        "mugs: 2 of 20 scenes, 1 failed, 0.1 scenes/s, 3 min left",
        "mugs: 4 of 20 scenes, 1 failed, 0.1 scenes/s, 2.7 min left",
        "mugs: 5 of 20 scenes, 1 failed, 0.1 scenes/s, 3.5 min left",
        "mugs: 20 of 20 scenes, 1 failed, 0.2 scenes/s, 0 s left",
    ]


def test_a_terminal_that_tells_no_width_has_a_bar_too():
    """A new pseudo-terminal has no rows and no columns."""
    ours, theirs = os.openpty()
    code = "from services.run.progress import ProgressLine as P; p = P(4, 'mugs'); p.show(3, 1); p.close()"
    subprocess.run([sys.executable, "-c", code], stderr=theirs, check=True, cwd=ROOT)
    os.close(theirs)
    said = os.read(ours, 10_000).decode()
    os.close(ours)
    assert "3/4" in said and "failed=1" in said


# ------------------------------------------------------------------------------------------------ metrics


@pytest.fixture
def place() -> str:
    return f"127.0.0.1:{free_port()}"


def test_what_is_counted_is_served_while_it_lasts(place):
    meter = Meter("mugs")
    with serve(meter, place):
        assert scrape(place)["verso_phase", "planning"] == 1.0
        tally = Tally(100, 40, Counter({"intrinsic: left_table": 3}), since=1.8e9, ranges=4, in_flight=7)
        tally.seconds = {"settle": 1.5, 'a "stage"\n': 2.0}
        meter.show({**tally.counts(2), "lost": {"memory": 1}})
        values = scrape(place)
    labelled = {
        ("scenes_failed_total", "intrinsic: left_table"): 3,
        ("workers_lost_total", "memory"): 1,
        ("stage_seconds_total", "settle"): 1.5,
        ("stage_seconds_total", 'a "stage"\n'): 2.0,
        ("phase", "making"): 1.0,
        ("phase", "planning"): 0.0,
    }
    plain = {"scenes_asked": 100, "scenes_made_total": 40, "commits_total": 4, "ranges_in_flight": 7, "slots": 2}
    plain["making_since_timestamp_seconds"] = 1.8e9
    for (name, *label), value in (labelled | {(name,): value for name, value in plain.items()}).items():
        assert values[f"verso_{name}", *label] == value
    with pytest.raises(urllib.error.URLError):
        scrape(place)
    with serve(Meter("mugs"), None), pytest.raises(urllib.error.URLError):
        scrape(place)


def test_a_port_that_is_taken_or_an_address_of_another_machine_is_told(place):
    with serve(Meter("mugs"), place):
        for other, words in ((place, r"in use.*another port"), ("192.0.2.1:9464", r"192\.0\.2\.1")):
            with pytest.raises(MachineError, match=words), serve(Meter("b"), other):
                pass
