"""`verso run`: makes a job's dataset, or the part of it that is missing."""

import contextlib
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from schemas.dataset.commit import Span
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE
from schemas.dataset.shard import ShardOrder
from schemas.job.job import Job
from services.job.record import adopt, encode_job, record_job, refuse_foreign
from services.merge.dataset_card import describe_left_out, describe_sources, write_card
from services.merge.step import MergeResult, merge, reopen
from services.run.coordinator import Coordinator, Limits, Tally
from services.run.lock import hold_lock
from services.run.out_folder import explain_lost_folder
from services.run.progress import ProgressLine, event_log, log_event
from services.run.range_planner import MAX_SHARD, choose_shard_size, group_shards, plan_spans
from services.run.ray_cluster import Slots, open_ray
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.render.step import require_tier
from workers.store.committed_rows import list_commits
from workers.store.local import open_store
from workers.store.store import Store
from workers.store.sweep import sweep


@dataclass(frozen=True)
class RunRequest:
    """The job to run, and where.

    Relative asset folders are resolved from `job_folder`; `out` is a URL or an absolute path, because workers have
    other working folders.
    """

    job: Job
    job_folder: Path
    out: str
    address: str | None = None
    retry_failed: bool = False


@dataclass(frozen=True)
class RunResult:
    """The merged dataset, the seconds that it took, and the scenes made in this run."""

    merged: MergeResult
    seconds: float
    made_now: int


def describe_plan(request: RunRequest) -> list[str]:
    """Lines that tell what a run would do, without doing any of it."""
    job = request.job
    require_tier(job.render)
    catalogue = _open_catalogue(request)
    return [
        f"job {job.name}: scenes {job.first_scene} to {job.stop_scene - 1}, {job.pairs_per_scene} pair(s) each, seed {job.seed}",
        f"categories: {', '.join(f'{name} {weight:g}' for name, weight in sorted(job.categories.items()))}",
        *describe_sources(catalogue),
        f"out: {request.out}, ranges of {job.run.range_size}, shards of {job.run.shard_size or f'up to {MAX_SHARD}'} scenes",
    ]


def run_job(request: RunRequest, cluster: contextlib.AbstractContextManager[Slots] | None = None) -> RunResult:
    """Makes the missing scenes, then merges. Raises VersoError.

    `cluster` is entered if there is something to make; by default it is the one that the request asks for.
    """
    begun = time.monotonic()
    require_tier(request.job.render)
    catalogue = _open_catalogue(request)
    store = open_store(request.out)
    for line in describe_left_out(catalogue):
        print(f"verso: {line}", file=sys.stderr)
    refuse_foreign(store)
    store.prepare()
    with explain_lost_folder(store.root), hold_lock(store), event_log(store.root):
        record = adopt(store, record_job(request.job, catalogue.digest, request.job_folder))
        sweep(store, fenced=None)
        commits = list_commits(store)
        spans = plan_spans(record.job, commits, request.retry_failed)
        store.write_whole(JOB_FILE, encode_job(record))
        if not commits:
            store.remove(FINGERPRINT_FILE)  # of a run that never made anything
        made_now = 0
        if spans:
            reopen(store)
            with cluster or open_ray(request.address, record.job.run.workers) as slots:
                made_now = _make(store, ShardOrder.of(request.out, record.job, record.digest), catalogue, spans, slots)
        merged = merge(store, record.job.first_scene, record.job.stop_scene)
        write_card(store, record, catalogue, merged)
        log_event("finished", job=record.job.name, digest=merged.digest)
    return RunResult(merged, time.monotonic() - begun, made_now)


def _open_catalogue(request: RunRequest) -> Catalogue:
    """The job's catalogue; shows how many files are listed and checked, which takes long where there are many new ones."""
    job, lines = request.job, dict[str, ProgressLine]()

    def watch(what: str, done: int, asked: int) -> None:
        if what not in lines:
            lines[what] = ProgressLine(asked, f"assets {what}", "file")
        lines[what].expect(asked)
        lines[what].show(done)

    try:
        return open_catalogue(job.assets, request.job_folder, tuple(job.categories), watch)
    finally:
        for line in lines.values():
            line.close()


def _make(store: Store, order: ShardOrder, catalogue: Catalogue, spans: Sequence[Span], slots: Slots) -> int:
    """Makes the ranges, and shows how many scenes are done. The number of scenes made."""
    job = order.job
    tally = Tally(asked=sum(len(span.scene_ids) for span in spans))
    log_event("started", job=job.name, scenes=tally.asked, slots=slots.running)
    limits = Limits(slots.in_flight, job.run.max_attempts, int(job.run.max_failure_share * job.scenes))
    shards = group_shards(spans, job.run.shard_size or choose_shard_size(tally.asked, slots.running))
    with contextlib.closing(ProgressLine(tally.asked, job.name)) as line:
        coordinator = Coordinator(store, order, catalogue, limits, tally)
        coordinator.run(shards, lambda now: line.show(now.done, now.failed.total()))
    return tally.made
