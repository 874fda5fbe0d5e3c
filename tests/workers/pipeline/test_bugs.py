"""A scene that ends in an error nobody expected: a row with its reason, the others made, all of it told."""

from pathlib import Path

import numpy as np
import pytest

from schemas.errors import MachineError
from tests.workers.pipeline.test_run_shard import run
from workers.shard import run_shard as module
from workers.shard.run_shard import describe, explain, keep_traceback
from workers.store.commit import read_record
from workers.store.ledger import range_rows
from workers.store.local import LocalStore

REAL = module.make_scene


def break_scene(monkeypatch: pytest.MonkeyPatch, scene_id: int, error: Exception) -> None:
    def make(context, scene, stopwatch):
        if scene == scene_id:
            raise error
        return REAL(context, scene, stopwatch)

    monkeypatch.setattr(module, "make_scene", make)


def failures_of(out: Path) -> list[dict]:
    store = LocalStore(out)
    record = read_record(store, 0, 0)
    assert record is not None
    return range_rows(store, [record], "failures").to_pylist()


def test_a_bug_in_one_scene_is_a_row_names_what_was_in_it_and_the_others_are_made(tmp_path, monkeypatch):
    break_scene(monkeypatch, 1, ZeroDivisionError("no such thing\nand more"))
    (span,) = run(tmp_path).spans
    assert (span.made, span.failed) == (1, {"environmental: bug": 1})
    (row,) = failures_of(tmp_path)
    assert (row["scene_id"], row["stage"], row["kind"], row["reason"]) == (1, "worker", "environmental", "bug")
    assert row["detail"].startswith("ZeroDivisionError: no such thing at test_bugs.py:")
    (told,) = span.bugs
    assert told.startswith(f"scene 1 ({row['category']} ")
    assert ", on table " in told
    assert "\n" not in told
    kept = (tmp_path / "_logs" / "scene-1.txt").read_text()
    assert "ZeroDivisionError: no such thing" in kept
    assert "Traceback" in kept


def test_an_output_that_breaks_the_schema_is_a_row_too(tmp_path, monkeypatch):
    real = module.run_scene

    def lacking(context, scene_id, total):
        output = real(context, scene_id, total)
        if scene_id == 0:
            output.rows["views"][0]["width"] = "wide"
        return output

    monkeypatch.setattr(module, "run_scene", lacking)
    (span,) = run(tmp_path).spans
    assert (span.made, span.failed) == (1, {"environmental: bug": 1})
    assert "scene 0 (" in span.bugs[0]
    assert failures_of(tmp_path)[0]["scene_id"] == 0
    images = [path.name for path in tmp_path.glob("*/*.png")]
    assert images
    assert not any("00000." in name or "00001." in name for name in images)


def test_memory_that_runs_out_in_one_scene_is_told_as_that(tmp_path, monkeypatch):
    break_scene(monkeypatch, 0, np._core._exceptions._ArrayMemoryError((10**6, 10**6), np.dtype(float)))
    (span,) = run(tmp_path).spans
    assert span.failed == {"environmental: memory": 1}
    assert "use fewer workers" in failures_of(tmp_path)[0]["detail"]


def test_an_error_of_the_machine_still_ends_the_shard(tmp_path, monkeypatch):
    break_scene(monkeypatch, 1, MachineError("the disk is full"))
    with pytest.raises(MachineError, match="the disk is full"):
        run(tmp_path)
    assert read_record(LocalStore(tmp_path), 0, 0) is None


def test_a_log_that_cannot_be_written_does_not_end_the_range(tmp_path):
    (tmp_path / "_logs").write_text("somebody's file")
    assert keep_traceback(LocalStore(tmp_path), 3, ValueError("x")) == ""


def test_an_error_without_words_or_place_still_has_one_line():
    assert describe(KeyError()) == "KeyError"
    assert explain(RuntimeError("x" * 5000)).detail.count("x") < 250
