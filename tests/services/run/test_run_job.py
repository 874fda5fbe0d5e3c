"""Whole runs on a real Ray: one dataset whatever the workers, shards, ranges, order, extensions, retries and deaths."""

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.dataset
import pytest

from schemas.errors import OutputError, RunError
from schemas.job.job import Job
from services.job.job_file import load_job, validate_job
from services.read.dataset_reader import iter_stored
from services.read.query import query
from services.read.replay import replay_scene
from services.read.verify import verify
from services.run.ray_cluster import Slots, private_ray
from services.run.run_job import RunRequest, run_job
from tests.kit.killed_runs import deadly_scene, disturb_at_first_commit, interrupt
from workers.store.images import decode_png
from workers.store.local import LocalStore

pytestmark = pytest.mark.ray

ROOT = Path(__file__).resolve().parents[3]

SMALL = {
    "name": "small",
    "seed": 11,
    "scenes": 24,
    "cameras": {"sensor": {"width": 160, "height": 120, "fx": 131.25, "fy": 131.25, "cx": 80.0, "cy": 60.0}},
    "images": {"patch": {"width": 32, "height": 24}},
    "check": {"raycast_share": 0.1, "mirror_agreement_mm": 5.0},
}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Slots]:
    """One Ray for every test of this file; a test takes as many of its two slots as it likes."""
    with private_ray(2) as slots:
        yield slots


def request(out: Path, **changes) -> RunRequest:
    job: Job = validate_job({**SMALL, **changes}, "test")
    return RunRequest(job, Path(), str(out))


def make(out: Path, slots: int = 2, **changes) -> str:
    in_flight = Slots(slots, slots)
    return run_job(request(out, **changes), contextlib.nullcontext(in_flight)).merged.digest


@pytest.fixture(scope="module")
def made(cluster, tmp_path_factory) -> tuple[Path, str]:
    """24 small scenes, made by one worker in one shard."""
    out = tmp_path_factory.mktemp("made") / "small"
    return out, make(out, slots=1, run={"shard_size": 64, "range_size": 16})


@pytest.mark.parametrize(
    ("slots", "run"),
    [
        (2, {"shard_size": 1, "range_size": 4}),
        pytest.param(2, {"shard_size": 7, "range_size": 16}, marks=pytest.mark.slow),
        (1, {"shard_size": 7, "range_size": 4}),
    ],
)
def test_workers_shards_and_ranges_do_not_change_the_dataset(made, tmp_path, slots, run):
    assert make(tmp_path / "again", slots=slots, run=run) == made[1]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_first_job_is_one_dataset_however_it_is_made(cluster, tmp_path):
    """All 64 full-size scenes of tabletop.yaml: workers 1 and 2, shards of 1, 7 and 64, ranges of 4 and 16, extended."""
    job = load_job(ROOT / "deploy" / "jobs" / "tabletop.yaml")

    def digest(name: str, slots: int, **run: int) -> str:
        out = tmp_path / name
        changed = job.model_copy(update={"scenes": run.pop("scenes", 64), "run": job.run.model_copy(update=run)})
        made = run_job(RunRequest(changed, Path(), str(out)), contextlib.nullcontext(Slots(slots, slots)))
        if changed.scenes == 64:
            shutil.rmtree(out)
        return made.merged.digest

    found = {
        digest(f"{slots}-{shard}-{size}", slots, shard_size=shard, range_size=size)
        for slots, shard, size in [(1, 64, 16), (2, 1, 4), (2, 7, 16), (2, 64, 4), (1, 7, 4), (2, 1, 16)]
    }
    digest("grown", 2, scenes=24, range_size=16)
    found.add(digest("grown", 2, scenes=64, range_size=16))
    assert len(found) == 1


def test_a_dataset_that_was_extended_is_the_one_made_at_once(made, tmp_path):
    out = tmp_path / "grown"
    first = make(out, scenes=9, run={"range_size": 4})
    assert first != made[1]
    assert make(out, scenes=24, run={"range_size": 16}) == made[1]
    assert make(out, scenes=24) == made[1]  # and running it again changes nothing


def test_another_seed_is_another_dataset(cluster, tmp_path):
    assert make(tmp_path / "other", seed=12, scenes=3) != make(tmp_path / "same", scenes=3)


def test_the_finished_folder_holds_what_was_promised(made):
    out, digest = made
    rows = pyarrow.dataset.dataset(out / "manifest" / "views", partitioning="hive").to_table().to_pylist()
    assert len(rows) == 24 * 4
    assert {row["role"] for row in rows} == {"input", "aligned", "mirror", "projected"}
    poses = (out / "camPoses.csv").read_text().splitlines()
    assert len(poses) == 1 + 48
    assert [len(line.split(",")) for line in poses] == [18] * 49
    assert [int(line.split(",")[0]) for line in poses[1:]] == list(range(48))
    assert [int(line.split(",")[1]) for line in poses[1:]] == [2 * (k // 2) for k in range(48)]
    objects = [line.split() for line in (out / "objects.dat").read_text().splitlines()]
    assert len(objects) == 48 * 2  # table and object in each pose
    assert {len(line) for line in objects} == {6 + 16}
    success = json.loads((out / "_SUCCESS").read_text())
    assert success["digest"] == digest
    assert (out / "DATASET.md").read_text().count(digest) == 1
    scenes = pyarrow.dataset.dataset(out / "manifest" / "scenes", partitioning="hive").to_table().to_pylist()
    assert sorted(row["scene_id"] for row in scenes) == list(range(24))
    checked = [row for row in scenes if row["raycast_checked"]]
    assert 0 < len(checked) < 24
    assert all(0 < row["recheck_move_mm"] < 0.3 for row in checked)
    assert all(row["recheck_move_mm"] is None for row in scenes if not row["raycast_checked"])
    assert max(row["penetration_mm"] for row in scenes) < 1e-6
    assert max(row["hover_gap_mm"] for row in scenes) < 1e-6
    assert min(row["support_margin_mm"] for row in scenes) > 0
    assert not list((out / "_staging").glob("*/*"))


def test_objects_dat_reprojects_to_its_image_coordinates(made):
    out, _ = made
    cameras = {
        row["pose_id"]: row
        for row in query(LocalStore(out), "select * from views where role in ('input', 'mirror')").to_pylist()
    }
    for line in (out / "objects.dat").read_text().splitlines():
        pose, _, _, _, u, v, *T = line.split()
        camera, (x, y, z) = cameras[int(pose)], np.reshape(np.array(T, float), (4, 4))[:3, 3]
        expected = camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"]
        inside = 0 <= expected[0] < camera["width"] and 0 <= expected[1] < camera["height"]
        assert (int(u), int(v)) == (tuple(int(np.floor(e)) for e in expected) if inside else (-1, -1))


def test_a_healthy_dataset_verifies_and_replays_to_the_byte(made):
    store = LocalStore(made[0])
    verdict = verify(store, lambda _: None)
    assert verdict.faults == []
    assert (verdict.scenes, verdict.pairs) == (24, 24)
    replayed = replay_scene(store, 5)
    assert replayed.same_stack
    assert replayed.differences == ()
    assert replayed.compared > 15


@pytest.fixture
def copy(made, tmp_path) -> Path:
    """A copy that a test may damage."""
    shutil.copytree(made[0], tmp_path / "copy")
    return tmp_path / "copy"


def faults_of(out: Path) -> str:
    return "\n".join(verify(LocalStore(out), lambda _: None).faults)


def test_a_flipped_bit_a_missing_and_a_foreign_image_are_found(copy):
    victim = sorted(copy.glob("*/RGB0*.png"))[3]
    data = bytearray(victim.read_bytes())
    data[-20] ^= 1
    victim.write_bytes(data)
    gone = sorted(copy.glob("*/segment0*.png"))[0]
    gone.unlink()
    (victim.parent / "RGB99999.png").write_bytes(b"x")
    told = faults_of(copy)
    assert f"{victim.parent.name}/{victim.name}: does not match" in told
    assert f"{gone.parent.name}/{gone.name}: is committed and missing" in told
    assert "RGB99999.png: is in no commit" in told


def test_a_changed_merged_file_is_found(copy):
    poses = copy / "camPoses.csv"
    poses.write_text(poses.read_text().replace("1", "2", 1))
    assert "camPoses.csv: does not match" in faults_of(copy)


def test_a_committed_range_whose_file_was_lost_is_told_by_the_next_run(copy):
    sorted(copy.glob("manifest/_ranges/*/views.parquet"))[0].unlink()
    (copy / "_SUCCESS").unlink()
    with pytest.raises(Exception, match=r"views\.parquet"):
        make(copy)


def test_a_folder_of_another_job_is_refused_naming_the_keys(copy):
    with pytest.raises(OutputError) as caught:
        make(copy, seed=12, start={"pose": "tumbled"})
    assert "seed: 11 there, 12 here" in str(caught.value)
    assert "start.pose: upright there, tumbled here" in str(caught.value)


def test_fewer_scenes_than_committed_are_refused_and_nothing_changes(copy):
    before = (copy / "job.yaml").read_bytes()
    with pytest.raises(OutputError, match="fewer scenes"):
        make(copy, scenes=8)
    assert (copy / "job.yaml").read_bytes() == before
    assert (copy / "_SUCCESS").exists()


def test_a_folder_with_somebodys_files_is_refused(tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(OutputError, match="photos"):
        make(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]


def test_every_pairs_images_have_their_sizes_and_types(made):
    store = LocalStore(made[0])
    stored = next(iter_stored(store))
    files = [file["path"] for row in stored.rows["views"] for file in row["files"]]
    assert len(files) > 16 * 11
    for path in files:
        pixels = decode_png(store.read(path))
        patch = "/patches/" in path
        assert pixels.shape[:2] == ((24, 32) if patch else (120, 160))
        assert pixels.dtype == (np.uint16 if "depth" in path else np.uint8)
        assert pixels.ndim == (3 if "RGB" in path else 2)


@pytest.mark.minute
def test_a_scene_that_kills_its_worker_becomes_a_row_and_the_rest_is_made(made, tmp_path):
    """The worker is killed for real, as the kernel would, each time it begins scene 6."""
    out = tmp_path / "deadly"
    changes = {"run": {"range_size": 4, "max_failure_share": 0.5, "max_attempts": 2}}
    with deadly_scene(out, 6) as killed:
        result = run_job(request(out, **changes), contextlib.nullcontext(Slots(2, 2)))
    assert len(killed) == 2
    assert result.merged.scenes == {"made": 23, "intrinsic": 0, "environmental": 1}
    assert not (out / "_SUCCESS").exists()
    (row,) = query(LocalStore(out), "select * from failures").to_pylist()
    assert (row["scene_id"], row["kind"], row["reason"], row["attempts"]) == (6, "environmental", "killed", 2)
    job = request(out, **changes).job
    retried = run_job(RunRequest(job, Path(), str(out), retry_failed=True), contextlib.nullcontext(Slots(2, 2)))
    assert retried.merged.digest == made[1]
    assert (out / "_SUCCESS").exists()
    assert faults_of(out) == ""


@pytest.mark.minute
def test_an_interrupted_run_says_so_leaves_no_process_and_goes_on_where_it_stopped(cluster, tmp_path):
    """Ctrl-C in a terminal. Of 40 scenes most are still to be made then."""
    changes = {"scenes": 40, "run": {"range_size": 4}}
    (tmp_path / "small.yaml").write_text(json.dumps(SMALL | changes))
    out = tmp_path / "stopped"
    run = disturb_at_first_commit(tmp_path / "small.yaml", out, interrupt)
    assert run.code == 1, run.told
    assert run.told.count("verso: ") == 1
    assert "verso: interrupted; what is committed is kept" in run.told
    assert "Traceback" not in run.told
    kept = len(list(out.glob("manifest/_commits/*.json")))
    assert 1 <= kept < 10
    assert run.left == []
    assert make(out, **changes) == make(tmp_path / "whole", **changes)


@pytest.mark.minute
def test_too_many_failures_stop_the_run_early_and_lose_nothing(cluster, tmp_path):
    out = tmp_path / "fragile"
    with deadly_scene(out, 2), pytest.raises(RunError, match="max_failure_share"):
        run_job(request(out, run={"range_size": 4, "max_attempts": 1}), contextlib.nullcontext(Slots(1, 1)))
    assert query(LocalStore(out), "select count(*) as n from scenes").to_pylist()[0]["n"] >= 3
