"""Stored ranges, scenes, pairs and geometry, what `verso status` tells of them, and the page of columns."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import OutputError
from schemas.job.job import Job
from services.cli.main import main
from services.job.record import encode_job, record_job
from services.merge.merge import merge
from services.read.columns_page import describe_columns, list_columns, write_page
from services.read.dataset_reader import (
    choose_scenes,
)
from services.read.status import read_status
from services.run.lock import hold_lock
from tests.made_up_scenes import attempt_at, failed_scene, scene
from workers.store.ledger import list_commits, save_rows
from workers.store.local import LocalStore

ROOT = Path(__file__).resolve().parents[3]


def test_scenes_are_chosen_evenly_by_seed_and_failed_ones_never(tmp_path, unflushed):
    store = LocalStore(tmp_path)
    store.prepare()
    for start in range(4, 20, 4):  # scenes 5 and 16 fail
        attempt_at(store, start, start + 4).commit()
    assert choose_scenes(store, 99, 0) == [scene for scene in range(4, 20) if scene not in (5, 16)]
    places = [choose_scenes(store, 99, 0).index(scene) for scene in choose_scenes(store, 7, 1)]
    assert set(np.diff(places)) == {2} and places[0] < 2
    assert len({tuple(choose_scenes(store, 4, seed)) for seed in range(9)}) > 1


# ---------------------------------------------------------------------------------------------- status


def test_scenes_are_counted_with_what_retries_changed(store, tmp_path):
    with pytest.raises(OutputError, match="holds no dataset"):
        read_status(LocalStore(tmp_path / "none"), 0, 4)
    killed = {1, 2, 3}
    attempt_at(store, 0, 4, make=lambda i: failed_scene(i, "environmental") if i in killed else scene(i)).commit()
    assert read_status(store, 0, 8).scenes_per_s is None  # of one commit
    attempt_at(store, 4, 8).commit()  # scene 5 fails
    attempt_at(store, 0, 4, retry=1, scenes=(1, 2, 3), make=lambda i: failed_scene(i) if i == 2 else scene(i)).commit()
    status = read_status(store, 0, 20)
    assert (status.asked, status.made, status.missing) == (20, 6, 12)
    assert status.failed == {"intrinsic: left_table": 2}
    assert (status.digest, status.holder) == (None, None)


def test_what_runs_is_told_with_the_scene_it_is_at(store):
    attempt_at(store, 0, 4).commit()
    busy = attempt_at(store, 4, 8)
    busy.begin_scene(6)
    lost = attempt_at(store, 0, 4)
    with hold_lock(store):
        status = read_status(store, 0, 8)
    assert [(one.start, one.attempt, one.scene_id) for one in status.running] == [(4, busy.name, 6)]
    assert status.holder.pid == os.getpid() and lost.name not in str(status)


def test_the_rate_is_that_of_the_latest_commits(store, monkeypatch):
    for number, start in enumerate(range(0, 24, 4)):
        attempt_at(store, start, start + 4).commit()
        written = 2e9 + number * 2 - (1e6 if number < 3 else 0)  # the first three were long ago
        os.utime(store.path(f"manifest/_commits/{start:010d}.json"), (written, written))
    monkeypatch.setattr("services.read.status.RATE_COMMITS", 3)
    assert read_status(store, 0, 24).scenes_per_s == 8 / 4


def test_the_rate_asks_few_records_for_their_time(store, monkeypatch):
    for start in range(0, 80, 4):
        attempt_at(store, start, start + 4, make=lambda i: failed_scene(i)).commit()
    save_rows(store, list_commits(store).rows)
    attempt_at(store, 84, 88).commit()
    attempt_at(store, 80, 84).commit()
    asked, stat = [], store.stat
    monkeypatch.setattr(store, "stat", lambda key: asked.extend([key] * ("_commits/" in key)) or stat(key))
    monkeypatch.setattr("services.read.status.RATE_LOOKS", 4)
    assert read_status(store, 0, 100).scenes_per_s > 0
    assert sorted(asked) == [f"manifest/_commits/{start:010d}.json" for start in (72, 76, 80, 84)]


def test_what_is_lost_is_told_and_a_finished_dataset_is_not_whole_then(store, capsys):
    for start in (0, 4):
        attempt_at(store, start, start + 4).commit()
    digest = merge(store, 0, 8).digest
    status = read_status(store, 0, 8)
    assert (status.digest, status.missing, status.running) == (digest, 0, ())
    store.put("job.yaml", encode_job(record_job(Job.model_validate({"name": "a", "scenes": 8}), "c", Path("/"))))
    assert main(["status", str(store.root)]) == 0
    save_rows(store, list_commits(store).rows)
    (store.root / "manifest/_commits/0000000004.json").unlink()
    capsys.readouterr()
    assert main(["status", str(store.root), "--json"]) == 1
    out = capsys.readouterr().out
    lost = "manifest/_commits/0000000004.json is lost: it was committed, and is gone; restore it from a copy, or run the job"
    assert lost in out
    answer = json.loads(out.splitlines()[-1])
    assert (answer["ok"], answer["missing"], len(answer["lost"])) == (False, 4, 1)


# ---------------------------------------------------------------------------------------------- columns


def test_every_column_stands_on_the_page_and_in_the_terminal(capsys):
    told = "run `python -m services.read.columns_page > docs/columns.md`"
    assert (ROOT / "docs/columns.md").read_text() == write_page(), told
    for table in TABLES:
        section = write_page().partition(f"\n## {table}\n")[2].partition("\n## ")[0]
        for name in SCHEMAS[table].names:
            assert f"`{name}`" in section
            assert any(line.startswith(f"  {name}  (") for line in describe_columns(table))
            assert any(one["path"] == name for one in list_columns(table))
        assert max(map(len, describe_columns(table))) <= 110
    assert main(["columns", "failures"]) == 0
    lines = ["failures: One row for each scene that could not be made, and why.", "  key: scene_id"]
    assert capsys.readouterr().out.splitlines()[:2] == lines
    assert main(["columns"]) == 0
    out = "\n" + capsys.readouterr().out
    assert all(f"\n{table}: " in out for table in TABLES)
    assert main(["columns", "view"]) == 2
    assert "there is no table 'view'; did you mean 'views'? Tables are scenes, views" in capsys.readouterr().err
    assert main(["columns", "failures", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)["columns"][0]
    named = {"table": "failures", "path": "scene_id", "type": "int64", "nullable": False, "unit": "id"}
    assert named.items() <= first.items() and not first["captures_only"]
