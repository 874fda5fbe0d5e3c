import json
import os
from pathlib import Path

import pytest

from schemas.errors import OutputError
from schemas.job.job import Job
from services.cli.main import main
from services.job.record import encode_job, record_job
from services.merge.merge import merge
from services.read.status import read_status
from services.run.lock import hold_lock
from tests.made_up_scenes import attempt_at, failed_scene, scene
from workers.store.ledger import list_commits, save_rows
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


def test_scenes_are_counted_with_what_retries_changed(store):
    killed = {1, 2, 3}
    attempt_at(store, 0, 4, make=lambda i: failed_scene(i, "environmental") if i in killed else scene(i)).commit()
    attempt_at(store, 4, 8).commit()  # scene 5 fails
    attempt_at(store, 0, 4, retry=1, scenes=(1, 2, 3), make=lambda i: failed_scene(i) if i == 2 else scene(i)).commit()
    status = read_status(store, 0, 20)
    assert (status.asked, status.made, status.missing) == (20, 6, 12)
    assert status.failed == {"intrinsic: left_table": 2}
    assert status.digest is None
    assert status.holder is None


def test_what_runs_is_told_with_the_scene_it_is_at(store):
    attempt_at(store, 0, 4).commit()
    busy = attempt_at(store, 4, 8)
    busy.begin_scene(6)
    lost = attempt_at(store, 0, 4)
    with hold_lock(store):
        status = read_status(store, 0, 8)
    assert [(one.start, one.attempt, one.scene_id) for one in status.running] == [(4, busy.name, 6)]
    assert status.holder.pid == os.getpid()
    assert lost.name not in str(status)


def test_the_rate_is_that_of_the_latest_commits(store, monkeypatch):
    for number, start in enumerate(range(0, 24, 4)):
        attempt_at(store, start, start + 4).commit()
        age = 1e6 if number < 3 else 0  # the first three were long ago
        path = store.path(f"manifest/_commits/{start:010d}.json")
        os.utime(path, (2e9 - age + number * 2, 2e9 - age + number * 2))
    monkeypatch.setattr("services.read.status.RATE_COMMITS", 3)
    assert read_status(store, 0, 24).scenes_per_s == 8 / 4


def test_one_commit_has_no_rate(store):
    attempt_at(store, 0, 4).commit()
    assert read_status(store, 0, 8).scenes_per_s is None


def test_a_finished_dataset_has_its_digest(store):
    attempt_at(store, 0, 4).commit()
    digest = merge(store, 0, 4).digest
    status = read_status(store, 0, 4)
    assert (status.digest, status.missing, status.running) == (digest, 0, ())


def test_the_rate_asks_few_records_for_their_time(store, monkeypatch):
    for start in range(0, 80, 4):
        attempt_at(store, start, start + 4, make=lambda i: failed_scene(i)).commit()
    save_rows(store, list_commits(store).rows)
    attempt_at(store, 84, 88).commit()
    attempt_at(store, 80, 84).commit()
    asked = []
    stat = store.stat
    monkeypatch.setattr(store, "stat", lambda key: asked.extend([key] * ("_commits/" in key)) or stat(key))
    monkeypatch.setattr("services.read.status.RATE_LOOKS", 4)
    assert read_status(store, 0, 100).scenes_per_s > 0
    assert sorted(asked) == [f"manifest/_commits/{start:010d}.json" for start in (72, 76, 80, 84)]


def test_what_is_lost_is_told_and_a_finished_dataset_is_not_whole_then(store, capsys):
    for start in (0, 4):
        attempt_at(store, start, start + 4).commit()
    merge(store, 0, 8)
    store.put("job.yaml", encode_job(record_job(Job.model_validate({"name": "a", "scenes": 8}), "c", Path("/"))))
    assert main(["status", str(store.root)]) == 0
    (store.root / "manifest/_commits/0000000004.json").unlink()
    capsys.readouterr()
    assert main(["status", str(store.root), "--json"]) == 1
    out = capsys.readouterr().out
    assert (
        "the commits of scenes 4 to 7 of the finished dataset are lost; restore it from a copy, or run the job" in out
    )
    answer = json.loads(out.splitlines()[-1])
    assert (answer["ok"], answer["missing"], len(answer["lost"])) == (False, 4, 1)


def test_a_folder_without_a_dataset_is_told(tmp_path):
    with pytest.raises(OutputError, match="holds no dataset"):
        read_status(LocalStore(tmp_path / "none"), 0, 4)
