"""A shard of small scenes through the real path onto disk."""

from collections.abc import Callable
from pathlib import Path

import pytest

from schemas.dataset.commit import CommitTerms, Span
from schemas.dataset.fingerprint import Fingerprint
from schemas.dataset.layout import FINGERPRINT_FILE, commit_path, range_table_path
from schemas.dataset.shard import Blame, ShardOrder, ShardReport
from schemas.errors import FingerprintError
from services.job.read import validate_job
from tests.effects.scenes import SMALL
from workers.assets.catalogue import open_catalogue
from workers.pipeline.run_shard import run_shard
from workers.store.local import LocalStore
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
        job_digest="test", fingerprint="", fingerprint_mode=mode, layout="files", first_scene=0, range_size=2
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
    store = LocalStore(tmp_path)
    report = run(tmp_path, stops=(2, 4, 6), is_over=lambda: store.size(commit_path(2)) is not None)
    assert [(span.start, span.won) for span in report.spans] == [(0, True), (2, True)]
    assert [path.name for path in (tmp_path / "_staging").glob("*/*")] == []
    assert run(tmp_path, stops=(8,), is_over=lambda: True).spans == ()


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
