"""Whole runs on a real Ray: one dataset whatever the workers, shards, ranges, extensions, retries and deaths."""

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import services.run.run_job
from schemas.errors import OutputError, RunError
from schemas.job.job import Job
from services.job.job_file import validate_job
from services.merge.merge import merge
from services.read.query import query
from services.run.ray_cluster import Slots, private_ray
from services.run.run_job import RunRequest, run_job
from tests.datasets import SMALL as SMALL_PAIR
from tests.datasets import faults_of, make_dataset, overlaid
from tests.kit.killed_runs import deadly_scene
from tests.kit.network import free_port
from tests.services.run.scraped import scrape
from workers.store.local import LocalStore

pytestmark = pytest.mark.ray

ROOT = Path(__file__).resolve().parents[3]
SCENES = 8
SMALL = {**SMALL_PAIR, "scenes": SCENES, "check": {"raycast_share": 0.2, "mirror_agreement_mm": 5.0}}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Slots]:
    """One Ray for every test of this file; a test takes as many of its two slots as it likes."""
    with private_ray(2) as slots:
        yield slots


def request(out: Path, retry_failed: bool = False, metrics: str | None = None, **changes) -> RunRequest:
    job: Job = validate_job(overlaid(SMALL, changes), "test")
    return RunRequest(job, Path(), str(out), retry_failed=retry_failed, metrics=metrics)


def make(out: Path, slots: int = 2, **changes):
    in_flight = Slots(slots, slots)
    return run_job(request(out, **changes), contextlib.nullcontext(in_flight)).merged


@pytest.fixture(scope="module")
def made(cluster, tmp_path_factory) -> tuple[Path, str]:
    """The small scenes, made by one worker in one shard."""
    out = tmp_path_factory.mktemp("made") / "small"
    return out, make(out, slots=1, run={"shard_size": 64, "range_size": 16}).digest


def test_workers_shards_ranges_and_an_extension_do_not_change_the_dataset(made, tmp_path):
    assert make(tmp_path / "split", run={"shard_size": 1, "range_size": 4}).digest == made[1]
    out = tmp_path / "grown"
    assert make(out, scenes=3, run={"range_size": 2}).digest != made[1]
    assert make(out, run={"range_size": 16}).digest == made[1]
    assert make(out).digest == made[1]  # and running it again changes nothing


@pytest.mark.minute
def test_scenes_of_several_objects_are_one_dataset_too_and_the_one_made_without_ray(cluster, tmp_path):
    changes = {"objects_per_scene": [2, 4], "scenes": 4, "categories": ["box", "camera", "bottle"]}
    digests = {
        make(tmp_path / "split", **changes, run={"shard_size": 1, "range_size": 2}).digest,
        make_dataset(tmp_path / "plain", **overlaid(SMALL, changes))[1],
    }
    assert make(tmp_path / "grown", **{**changes, "scenes": 2}, run={"range_size": 1}).digest not in digests
    grown = make(tmp_path / "grown", **changes, run={"range_size": 4})
    assert digests == {grown.digest}
    assert grown.scenes == {"made": 4, "intrinsic": 0, "environmental": 0}


def test_the_finished_folder_holds_what_was_promised(made):
    out, digest = made
    assert faults_of(LocalStore(out)) == []
    scenes = query(LocalStore(out), "select * from scenes").to_pylist()
    success = json.loads((out / "_SUCCESS").read_text())
    assert success["digest"] == digest
    assert (out / "DATASET.md").read_text().count(digest) == 1
    assert sorted(row["scene_id"] for row in scenes) == list(range(SCENES))
    checked = [row for row in scenes if row["raycast_checked"]]
    assert 0 < len(checked) < SCENES
    assert all(0 < row["recheck_move_mm"] < 0.3 for row in checked)
    assert all(row["recheck_move_mm"] is None for row in scenes if not row["raycast_checked"])
    for name in ("penetration_mm", "hover_gap_mm"):
        assert max(row[name] for row in scenes) < 1e-6
    assert min(row["support_margin_mm"] for row in scenes) > 0
    assert not list((out / "_staging").glob("*/*"))


@pytest.mark.minute
def test_what_does_not_belong_to_the_job_is_refused_and_left_as_it_is(made, tmp_path):
    copy, photos = tmp_path / "copy", tmp_path / "theirs" / "photos"
    shutil.copytree(made[0], copy)
    photos.mkdir(parents=True)
    before = (copy / "job.yaml").read_bytes()
    for out, changes, words in (
        (photos.parent, {}, ["photos"]),
        (copy, {"scenes": 4}, ["fewer scenes"]),
        (
            copy,
            {"seed": 12, "start": {"pose": "tumbled"}},
            ["seed: 11 there, 12 here", "start.pose: upright there, tumbled here"],
        ),
    ):
        with pytest.raises(OutputError) as caught:
            make(out, **changes)
        assert all(word in str(caught.value) for word in words)
    assert [path.name for path in photos.parent.iterdir()] == ["photos"]
    assert (copy / "job.yaml").read_bytes() == before and (copy / "_SUCCESS").exists()
    sorted(copy.glob("manifest/_ranges/*/views.parquet"))[0].unlink()
    (copy / "_SUCCESS").unlink()
    with pytest.raises(Exception, match=r"views\.parquet"):
        make(copy)


def test_a_run_serves_what_it_has_made_and_how_long_each_stage_took(cluster, tmp_path, monkeypatch):
    seen, place = {}, f"127.0.0.1:{free_port()}"

    def look_then_merge(*args):
        seen.update(scrape(place))
        return merge(*args)

    monkeypatch.setattr(services.run.run_job, "merge", look_then_merge)
    result = make(tmp_path / "out", 1, scenes=5, metrics=place, run={"range_size": 4})
    assert seen["verso_phase", "merging"] == 1.0
    assert seen["verso_scenes_made_total",] == result.scenes["made"] > 0
    assert seen["verso_scenes_asked",] == 5
    assert seen["verso_commits_total",] == 2
    assert seen["verso_stage_seconds_total", "physics"] > 0.0
    assert seen["verso_ranges_in_flight",] == 0


@pytest.mark.minute
def test_a_scene_that_kills_its_worker_becomes_a_row_and_too_many_of_them_end_the_run(made, tmp_path):
    """The worker is killed for real, as the kernel would, each time it begins scene 6."""
    out = tmp_path / "deadly"
    run = {"range_size": 4, "max_failure_share": 0.5, "max_attempts": 2}
    with deadly_scene(out, 6) as killed:
        merged = make(out, run=run)
    assert len(killed) == 2
    assert merged.scenes == {"made": SCENES - 1, "intrinsic": 0, "environmental": 1}
    assert not (out / "_SUCCESS").exists()
    (row,) = query(LocalStore(out), "select * from failures").to_pylist()
    assert (row["scene_id"], row["kind"], row["reason"], row["attempts"]) == (6, "environmental", "killed", 2)
    assert make(out, run=run, retry_failed=True).digest == made[1]
    assert (out / "_SUCCESS").exists() and faults_of(LocalStore(out)) == []
    fragile = tmp_path / "fragile"
    with deadly_scene(fragile, 2), pytest.raises(RunError, match="max_failure_share"):
        make(fragile, 1, run={"range_size": 4, "max_attempts": 1})
    assert query(LocalStore(fragile), "select count(*) as n from scenes").to_pylist()[0]["n"] >= 3
