"""A shard of small scenes through the real path onto disk."""

import itertools
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from schemas.dataset.commit import CommitTerms, Span
from schemas.dataset.layout import FINGERPRINT_FILE, commit_path, range_table_path
from schemas.dataset.shard import Blame, Fingerprint, ShardOrder, ShardReport
from schemas.errors import FingerprintError, MachineError
from services.job.job_file import validate_job
from tests.effects.scenes import SMALL
from workers.assets.catalogue import open_catalogue
from workers.shard.run_shard import run_shard
from workers.store.attempt import Attempt, blamed_scene, staged_attempts
from workers.store.local import LocalStage, LocalStore
from workers.store.manifest import decode_table

OTHER = Fingerprint(canary="0" * 64, code="0" * 64, libraries={}, simd="none", renderer="none")


def run(
    out: Path,
    mode: str = "record",
    stops: tuple[int, ...] = (2,),
    blamed: tuple[Blame, ...] = (),
    is_over: Callable[[], bool] = lambda: False,
) -> ShardReport:
    job = validate_job(SMALL, "a test")
    terms = CommitTerms(
        job_digest="test",
        fingerprint="",
        fingerprint_mode=mode,
        layout="files",
        first_scene=0,
        range_size=2,
        pairs_per_scene=job.pairs_per_scene,
    )
    spans = tuple(Span(start=stop - 2, stop=stop) for stop in stops)
    order = ShardOrder(out=str(out), job=job, terms=terms, spans=spans, blamed=blamed)
    LocalStore(out).prepare()
    return run_shard(order, open_catalogue(job.assets, Path(), tuple(job.categories)), is_over)


def test_every_range_of_a_shard_is_committed_and_reported_in_order(tmp_path):
    report = run(tmp_path, stops=(2, 4))
    assert [(span.start, span.stop, span.won, span.made) for span in report.spans] == [(0, 2, True, 2), (2, 4, True, 2)]
    assert {"assets", "plan", "physics", "render", "encode", "write", "commit"} <= report.seconds.keys()
    again = run(tmp_path, stops=(2,)).spans[0]
    assert (again.won, again.conflict) == (False, None), "a second attempt loses, and made the same bytes"


def test_a_worker_that_is_to_end_finishes_its_range_and_begins_no_other(tmp_path):
    asked = itertools.count()
    report = run(tmp_path, stops=(2, 4, 6), is_over=lambda: next(asked) == 2)
    assert [(span.start, span.won) for span in report.spans] == [(0, True), (2, True)]
    assert [path.name for path in (tmp_path / "_staging").glob("*/*")] == []
    assert run(tmp_path, stops=(8,), is_over=lambda: True).spans == ()


def test_the_next_range_is_made_while_a_commit_waits_for_the_disk(tmp_path, monkeypatch):
    begun = threading.Event()
    begin_scene, flush = Attempt.begin_scene, LocalStage.flush

    def note(attempt, scene_id):
        begin_scene(attempt, scene_id)
        if scene_id == 2:
            begun.set()

    def wait(stage):
        assert begun.wait(60.0), "scene 2 is not begun while the range before it is committed"
        flush(stage)

    monkeypatch.setattr(Attempt, "begin_scene", note)
    monkeypatch.setattr(LocalStage, "flush", wait)
    assert [span.won for span in run(tmp_path, stops=(2, 4)).spans] == [True, True]


def test_one_range_at_a_time_is_committed_in_order(tmp_path, monkeypatch):
    commit, events = Attempt.commit, []

    def watched(attempt, job_change):
        events.append(attempt.span.start)
        time.sleep(0.5)
        result = commit(attempt, job_change)
        events.append(attempt.span.start)
        return result

    monkeypatch.setattr(Attempt, "commit", watched)
    run(tmp_path, stops=(2, 4, 6))
    assert events == [0, 0, 2, 2, 4, 4]


def test_a_range_that_cannot_be_committed_is_told_and_made_again_by_the_next_run(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(LocalStage, "flush", raises(MachineError("the disk is full")))
        with pytest.raises(MachineError, match="the disk is full"):
            run(tmp_path, stops=(2, 4, 6))
    store = LocalStore(tmp_path)
    assert [store.size(commit_path(start)) for start in (0, 2, 4)] == [None] * 3
    assert [span.won for span in run(tmp_path, stops=(2, 4, 6)).spans] == [True] * 3


def test_an_error_in_a_range_lets_the_commit_before_it_end(tmp_path, monkeypatch):
    flush, failed = LocalStage.flush, threading.Event()

    def fail(attempt, scene_id):
        if scene_id == 2:
            failed.set()
            raise MachineError("the GPU is gone")

    def wait(stage):
        failed.wait(60.0)
        flush(stage)

    monkeypatch.setattr(Attempt, "begin_scene", fail)
    monkeypatch.setattr(LocalStage, "flush", wait)
    with pytest.raises(MachineError, match="the GPU is gone"):
        run(tmp_path, stops=(2, 4))
    store = LocalStore(tmp_path)
    assert store.size(commit_path(0)) is not None
    assert store.size(commit_path(2)) is None


def test_a_range_that_waits_for_the_commit_before_it_has_no_scene_in_progress(tmp_path, monkeypatch):
    flush, ended, noted = LocalStage.flush, threading.Event(), []
    end_scenes = Attempt.end_scenes

    def note(attempt):
        end_scenes(attempt)
        if attempt.span.start == 2:
            ended.set()

    def wait(stage):
        assert ended.wait(60.0)
        store = LocalStore(tmp_path)
        noted.extend(blamed_scene(store, start, name) for start, name in staged_attempts(store))
        flush(stage)

    monkeypatch.setattr(Attempt, "end_scenes", note)
    monkeypatch.setattr(LocalStage, "flush", wait)
    run(tmp_path, stops=(2, 4))
    assert noted[:2] == [None, None]


def raises(error: Exception) -> Callable[..., None]:
    def fail(*_: object) -> None:
        raise error

    return fail


def test_a_scene_that_killed_its_workers_is_a_row_and_is_not_tried_again(tmp_path):
    blame = Blame(scene_id=1, reason="killed", detail="three workers died in it", attempts=3)
    (span,) = run(tmp_path, blamed=(blame,)).spans
    assert (span.made, span.failed) == (1, {"environmental: killed": 1})
    (row,) = decode_table("failures", LocalStore(tmp_path).read(range_table_path(0, "failures")), "here").to_pylist()
    assert (row["scene_id"], row["stage"], row["detail"], row["attempts"]) == (1, "worker", blame.detail, 3)


def test_a_worker_of_another_stack_is_refused_unless_the_job_records_stacks(tmp_path):
    (tmp_path / FINGERPRINT_FILE).parent.mkdir(parents=True)
    (tmp_path / FINGERPRINT_FILE).write_text(OTHER.model_dump_json())
    with pytest.raises(FingerprintError, match=f"the dataset's is {OTHER.digest[:12]}"):
        run(tmp_path, mode="strict")
    assert run(tmp_path, mode="record").spans[0].won
