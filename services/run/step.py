"""`verso run`: from a job to a finished dataset, or further towards one."""

import contextlib
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from schemas.dataset.commit import CommitTerms, Span
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE
from schemas.dataset.shard import ShardOrder
from schemas.job.job import Job
from services.job.record import JobRecord, adopt, encode_job, record_job, refuse_foreign
from services.merge.dataset_card import describe_left_out, describe_sources, write_card
from services.merge.step import MergeResult, merge, reopen
from services.run.coordinator import Limits, Tally, run_spans
from services.run.cores import usable_cores
from services.run.lock import hold_lock
from services.run.progress import ProgressLine, event_log, log_event
from services.run.range_planner import committed_ranges, plan_ranges, plan_retries
from services.run.ray_cluster import Slots, cluster_ray, private_ray
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.render.step import require_tier
from workers.store.committed_rows import list_commits
from workers.store.opening import open_store
from workers.store.store import Store
from workers.store.sweep import sweep

USUAL_SHARD = 64
"""Scenes in a shard of a large job: seconds of work for each millisecond that Ray takes to hand it out."""


@dataclass(frozen=True)
class RunRequest:
    """What the user asked for.

    Relative asset folders are resolved from `job_folder`; `out` is a URL or an absolute path, because workers stand
    elsewhere.
    """

    job: Job
    job_folder: Path
    out: str
    address: str | None = None
    retry_failed: bool = False


@dataclass(frozen=True)
class RunResult:
    """What came of it."""

    merged: MergeResult
    seconds: float
    made_now: int
    out: str


def describe_plan(request: RunRequest) -> list[str]:
    """What a run would do, without doing any of it."""
    job = request.job
    require_tier(job.render)
    catalogue = open_catalogue(job.assets, request.job_folder, tuple(job.categories))
    lines = [
        f"job {job.name}: scenes {job.first_scene} to {job.stop_scene - 1}, {job.pairs_per_scene} pair(s) each, seed {job.seed}",
        f"categories: {', '.join(f'{name} {weight:g}' for name, weight in sorted(job.categories.items()))}",
        *describe_sources(catalogue),
        f"out: {request.out}, ranges of {job.run.range_size}, shards of {job.run.shard_size or f'up to {USUAL_SHARD}'} scenes",
    ]
    return lines


def run_job(request: RunRequest, cluster: contextlib.AbstractContextManager[Slots] | None = None) -> RunResult:
    """Make what is missing, merge, and say what came of it. Raises VersoError.

    `cluster` is entered if there is something to make; by default it is what the request asks for.
    """
    begun = time.monotonic()
    require_tier(request.job.render)
    catalogue = open_catalogue(request.job.assets, request.job_folder, tuple(request.job.categories))
    for line in describe_left_out(catalogue):
        print(f"verso: {line}", file=sys.stderr)
    store = open_store(request.out)
    refuse_foreign(store)
    store.prepare()
    with hold_lock(store), _logging(store):
        record = adopt(store, record_job(request.job, catalogue.digest, request.job_folder))
        sweep(store, fenced=None)
        spans = _missing_spans(store, record.job, request.retry_failed)
        store.write_whole(JOB_FILE, encode_job(record))
        tally = Tally(asked=sum(len(span.scene_ids) for span in spans))
        if spans:
            reopen(store)
            with cluster or _cluster(request) as slots:
                _make(_order(request, record), catalogue, spans, slots, tally)
        merged = merge(store, record.job.first_scene, record.job.stop_scene)
        write_card(store, record, catalogue, merged)
    log_event("finished", job=record.job.name, digest=merged.digest)
    return RunResult(merged, time.monotonic() - begun, tally.made, request.out)


def _logging(store: Store) -> contextlib.AbstractContextManager[None]:
    return event_log(store.root) if store.root is not None else contextlib.nullcontext()


def _missing_spans(store: Store, job: Job, retry_failed: bool) -> list[Span]:
    """What is to be made. Raises OutputError where more is committed than the job asks for."""
    commits = list_commits(store)
    if not commits:
        store.remove(FINGERPRINT_FILE)  # of a run that never made anything
    ranges = plan_ranges(job.first_scene, job.stop_scene, job.run.range_size, committed_ranges(commits))
    spans = [Span(start=start, stop=stop) for start, stop in ranges]
    return spans + plan_retries(commits) if retry_failed else spans


def _order(request: RunRequest, record: JobRecord) -> ShardOrder:
    """The pattern of every shard's order."""
    return ShardOrder(out=request.out, job=record.job, terms=_terms(record), spans=())


def _make(order: ShardOrder, catalogue: Catalogue, spans: Sequence[Span], slots: Slots, tally: Tally) -> None:
    job = order.job
    log_event("started", job=job.name, scenes=tally.asked, slots=slots.running)
    shards = group_shards(spans, job.run.shard_size or _fair_shard(tally.asked, slots.running))
    limits = Limits(slots.in_flight, job.run.max_attempts, int(job.run.max_failure_share * job.scenes))
    line = ProgressLine(tally.asked, job.name)
    try:
        run_spans((order, catalogue), shards, limits, lambda now: line.show(now.done, now.failed.total()), tally)
    finally:
        line.close()


def _terms(record: JobRecord) -> CommitTerms:
    job = record.job
    return CommitTerms(
        job_digest=record.digest,
        fingerprint="",
        fingerprint_mode=job.run.fingerprint,
        layout=job.output.layout,
        first_scene=job.first_scene,
        range_size=job.run.range_size,
    )


def _cluster(request: RunRequest) -> contextlib.AbstractContextManager[Slots]:
    workers = request.job.run.workers
    if request.address is not None:
        return cluster_ray(request.address, workers)
    return private_ray(workers or usable_cores())


def _fair_shard(scenes: int, slots: int) -> int:
    """Large enough that Ray costs little, small enough that every slot has at least two."""
    return min(USUAL_SHARD, math.ceil(scenes / (2 * slots)))


def group_shards(spans: Sequence[Span], shard_size: int) -> Iterator[tuple[Span, ...]]:
    """Whole ranges in order, together until they hold at least `shard_size` scenes.

    Made one at a time, as they are asked for.
    """
    shard: list[Span] = []
    for span in spans:
        shard.append(span)
        if sum(len(one.scene_ids) for one in shard) >= shard_size:
            yield tuple(shard)
            shard = []
    if shard:
        yield tuple(shard)
