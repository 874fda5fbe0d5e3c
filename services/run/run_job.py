"""`verso run`: makes a job's dataset, or the part of it that is missing."""

import contextlib
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from schemas.dataset.commit import Ledger
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE
from schemas.dataset.shard import JobChange, ShardOrder
from schemas.errors import FingerprintError, plural
from schemas.job.job import Job
from services.job.job_file import describe_idle
from services.job.record import JobRecord, encode_job, record_job, refuse_foreign
from services.merge.merge import MergeResult, merge
from services.merge.tables import write_card
from services.run.coordinator import Coordinator, Limits
from services.run.joining import Pattern, join_cluster, terms_of_driver, with_own_stack
from services.run.lock import Lock, explain_lost_folder, hold_lock
from services.run.metrics import Meter, Tally, serve
from services.run.parts import find_parts
from services.run.progress import ProgressLine, event_log, log_event, show_counts
from services.run.range_planner import SpanPlan, deal_shards, find_lost, group_shards, plan_spans
from services.run.ray_cluster import Slots, nodes_here, open_ray, share_gpus, share_slots
from workers.assets.catalogue import Catalogue
from workers.capture.results import open_sources
from workers.render.tiers import require_tier
from workers.source import are_kept
from workers.store.attempt import sweep
from workers.store.ledger import LedgerKeeper, list_commits
from workers.store.local import open_store
from workers.store.store import Store


@dataclass(frozen=True)
class RunRequest:
    """The job to run, and where.

    Relative asset folders are resolved from `job_folder`; `out` is a URL or an absolute path, because workers have
    other working folders. `metrics`: HOST:PORT where Prometheus may read what the run counts.
    `sharing` tells how many jobs share the cluster now.
    """

    job: Job
    job_folder: Path
    out: str
    address: str | None = None
    retry_failed: bool = False
    metrics: str | None = None
    sharing: Callable[[], int] | None = None


@dataclass(frozen=True)
class Run:
    """A run on an output folder that this process holds: the state that its phases share and do not change.

    `plan`: what is missing; `keeper`: takes new commits into the kept summary of the ledger; `meter`: what Prometheus reads.
    """

    request: RunRequest
    catalogue: Catalogue
    store: Store
    lock: Lock
    meter: Meter
    record: JobRecord
    ledger: Ledger
    keeper: LedgerKeeper
    plan: SpanPlan


@dataclass(frozen=True)
class RunResult:
    """The merged dataset, the seconds that it took, and the scenes made in this run."""

    merged: MergeResult
    seconds: float
    made_now: int


def run_job(request: RunRequest, cluster: contextlib.AbstractContextManager[Slots] | None = None) -> RunResult:
    """Makes the missing scenes, then merges. Raises VersoError.

    `cluster` is entered if there is something to make; by default it is the one that the request asks for.
    """
    begun = time.monotonic()
    catalogue, store = open_inputs(request)
    refuse_foreign(store)
    store.prepare()
    meter = Meter(request.job.name)
    with (
        explain_lost_folder(store.root),
        hold_lock(store) as lock,
        event_log(store.root),
        serve(meter, request.metrics),
    ):
        run = plan_run(request, catalogue, store, lock, meter)
        with contextlib.closing(run.keeper):
            made_now = make_missing(run, cluster) if run.plan.scenes else 0
        meter.enter("merging")
        merged = finish(run)
        meter.enter("done")
    return RunResult(merged, time.monotonic() - begun, made_now)


def open_inputs(request: RunRequest) -> tuple[Catalogue, Store]:
    """The job's catalogue and its output folder, which need not be there yet; says which files are left out or doubtful.

    Shows how many files are listed and checked, which takes long where there are many new ones.
    """
    with show_counts("assets") as watch:
        require_tier(request.job.drawn)
        catalogue = open_sources(request.job, request.job_folder, watch)
        store = open_store(request.out)
    for line in (*describe_idle(request.job), *catalogue.describe_left_out(), *catalogue.describe_doubts()):
        print(f"verso: {line}", file=sys.stderr)
    find_parts(request.job, catalogue)
    return catalogue, store


def plan_run(request: RunRequest, catalogue: Catalogue, store: Store, lock: Lock, meter: Meter) -> Run:
    """What there is and what is missing. Raises OutputError where the folder belongs to another job."""
    inputs = tuple(listing.sha256 for listing in catalogue.captures)
    record = record_job(request.job, catalogue.digest, request.job_folder, inputs, out=store)
    sweep(store, fenced=None)
    ledger = list_commits(store)
    keeper = LedgerKeeper(store, ledger)
    for line in find_lost(store, ledger):
        print(f"verso: {line}", file=sys.stderr)
    plan = plan_spans(record.job, ledger, request.retry_failed)
    return Run(request, catalogue, store, lock, meter, record, ledger, keeper, plan)


def make_missing(run: Run, cluster: contextlib.AbstractContextManager[Slots] | None) -> int:
    """Makes what the plan has on a Ray, and shows how many scenes are done. The number of scenes made."""
    request, job = run.request, run.record.job
    pattern = Pattern(order_pattern(run.store, run.record, run.ledger), run.catalogue, terms_of_driver())
    if request.address is not None:
        pattern = replace(pattern, order=with_own_stack(run.store, pattern.order))
    there = f", {run.ledger.committed} are there" if run.ledger.committed else ""
    own = os.environ.get("NUMBA_CACHE_DIR")  # noqa: TID251 - numba itself reads it nowhere else
    note = "" if request.address or are_kept(own) else " (a first start compiles for up to a minute)"
    print(
        f"{job.name}: {plural(run.plan.scenes, 'scene')} to make{there}; starting the workers{note}",
        file=sys.stderr,
        flush=True,
    )
    with cluster or open_ray(request.address, job.run.workers) as slots:
        if request.address is not None:
            pattern = join_cluster(run.store, run.lock, pattern)
        if request.sharing is not None:
            slots = share_slots(slots, request.sharing)
        return _coordinate(run, pattern, slots)


def finish(run: Run) -> MergeResult:
    """Brings job.yaml up to date, merges, and writes the card. Raises RunError where the lock was lost."""
    job, text = run.record.job, encode_job(run.record)
    if run.store.size(JOB_FILE) is None or run.store.read(JOB_FILE) != text:
        run.store.put(JOB_FILE, text)
    merged = merge(run.store, job.first_scene, job.stop_scene, run.lock.require_held)
    write_card(run.store, run.record, run.catalogue, merged)
    log_event("finished", job=job.name, digest=merged.digest)
    return merged


def order_pattern(store: Store, record: JobRecord, ledger: Ledger) -> ShardOrder:
    """The pattern of all orders. A new folder gets its job.yaml at once, a finished one a moment before a new commit."""
    order = ShardOrder.of(store.name, record.job, record.digest)
    text = encode_job(record)
    change = None
    if store.size(JOB_FILE) is None:
        store.put(JOB_FILE, text)
    elif (before := store.read(JOB_FILE)) != text:
        change = JobChange(before=before.decode(), after=text.decode())
    if not ledger.rows.num_rows and not ledger.lost:
        store.remove(FINGERPRINT_FILE)  # of a run that never made anything
    terms = order.terms.model_copy(update={"fingerprint": _committed_stack(store, record.job, ledger)})
    return order.model_copy(update={"job_change": change, "terms": terms})


def _committed_stack(store: Store, job: Job, ledger: Ledger) -> str:
    """The fingerprint that every worker of a strict job must have; empty where none is committed or any may come.

    Raises FingerprintError where the commits have several.
    """
    stacks = ledger.fingerprints if job.run.fingerprint == "strict" else []
    if len(stacks) > 1:
        raise FingerprintError(
            f"the commits of {store.name} were made by {len(stacks)} stacks ({', '.join(one[:12] for one in stacks[:3])}), "
            "and run.fingerprint is strict: set it to record to go on"
        )
    return stacks[0] if stacks else ""


def _coordinate(run: Run, pattern: Pattern, slots: Slots) -> int:
    """Gives the missing ranges to Ray and follows what becomes of them. The number of scenes made."""
    job, plan = run.record.job, run.plan
    tally = Tally(asked=plan.scenes)
    log_event("started", job=job.name, scenes=tally.asked, slots=slots.running)
    num_gpus = share_gpus(nodes_here(), slots.running, job.run)
    limits = Limits(slots, job.run.max_attempts, int(job.run.max_failure_share * job.scenes), num_gpus)
    if job.run.shard_size is not None:
        shards = group_shards(plan, job.run.shard_size)
    else:
        shards = deal_shards(plan, plan.scenes, job.range_size, lambda: slots.now().running)
    with contextlib.closing(ProgressLine(tally.asked, job.name)) as line:

        def follow(now: Tally) -> None:
            line.show(now.done + now.under_way, now.failed.total())
            run.keeper.add(now.take_commits())
            run.meter.show(now.counts(slots.now().running))

        Coordinator(run.store, pattern, limits, tally).run(shards, follow)
    return tally.made
