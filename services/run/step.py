"""`verso run`: makes a job's dataset, or the part of it that is missing."""

import contextlib
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE
from schemas.dataset.ledger import Ledger
from schemas.dataset.shard import JobChange, ShardOrder
from schemas.errors import FingerprintError
from schemas.job.job import Job
from services.job.record import JobRecord, adopt, encode_job, record_job, refuse_foreign
from services.merge.dataset_card import describe_doubts, describe_left_out, write_card
from services.merge.merge import MergeResult, merge
from services.run.coordinator import Coordinator, Limits
from services.run.joining import join_cluster, terms_of_driver, with_own_stack
from services.run.lock import hold_lock
from services.run.losses import find_lost
from services.run.metrics import Meter, serve
from services.run.out_folder import explain_lost_folder
from services.run.pattern import Pattern
from services.run.progress import ProgressLine, event_log, log_event, note_of_first_start
from services.run.range_planner import SpanPlan, deal_shards, group_shards, plan_spans
from services.run.ray_cluster import open_ray
from services.run.slots import SharedSlots, Slots
from services.run.tally import Tally
from workers.assets.catalogue import Catalogue
from workers.pipeline.captures.listing import open_sources
from workers.render.tiers import require_tier
from workers.store.attempt import sweep
from workers.store.ledger import LedgerKeeper, list_commits
from workers.store.store import Store, open_store


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
    require_tier(request.job.drawn)
    catalogue = open_catalogue(request)
    store = open_store(request.out)
    for line in (*describe_left_out(catalogue), *describe_doubts(catalogue)):
        print(f"verso: {line}", file=sys.stderr)
    refuse_foreign(store)
    store.prepare()
    meter = Meter(request.job.name)
    with (
        explain_lost_folder(store.root),
        hold_lock(store) as lock,
        event_log(store.root),
        serve(meter, request.metrics),
    ):
        record = adopt(store, record_of(request, catalogue))
        sweep(store, fenced=None)
        ledger = list_commits(store)
        for line in find_lost(store, ledger):
            print(f"verso: {line}", file=sys.stderr)
        plan = plan_spans(record.job, ledger, request.retry_failed)
        made_now = 0
        with contextlib.closing(LedgerKeeper(store, ledger)) as keeper:
            if plan.scenes:
                pattern = Pattern(order_pattern(store, request.out, record, ledger), catalogue, terms_of_driver())
                if request.address is not None:
                    pattern = replace(pattern, order=with_own_stack(store, pattern.order))
                there = f", {ledger.committed} are there" if ledger.committed else ""
                print(
                    f"{record.job.name}: {plan.scenes} scenes to make{there}; starting the workers"
                    f"{'' if request.address else note_of_first_start()}",
                    file=sys.stderr,
                    flush=True,
                )
                with cluster or open_ray(request.address, record.job.run.workers) as slots:
                    if request.address is not None:
                        pattern = join_cluster(store, lock, pattern)
                    own = SharedSlots.of(slots, request.sharing) if request.sharing else slots
                    made_now = _make(store, pattern, plan, own, keeper, meter)
        meter.enter("merging")
        if store.size(JOB_FILE) is None or store.read(JOB_FILE) != encode_job(record):
            store.put(JOB_FILE, encode_job(record))
        merged = merge(store, record.job.first_scene, record.job.stop_scene, lock.require_held)
        write_card(store, record, catalogue, merged)
        log_event("finished", job=record.job.name, digest=merged.digest)
        meter.enter("done")
    return RunResult(merged, time.monotonic() - begun, made_now)


def record_of(request: RunRequest, catalogue: Catalogue) -> JobRecord:
    """The record of the job that is asked for, with what its sources hold now."""
    inputs = tuple(listing.sha256 for listing in catalogue.captures)
    return record_job(request.job, catalogue.digest, request.job_folder, inputs)


def open_catalogue(request: RunRequest) -> Catalogue:
    """The job's catalogue; shows how many files are listed and checked, which takes long where there are many new ones."""
    lines = dict[str, ProgressLine]()

    def watch(what: str, done: int, asked: int) -> None:
        if what not in lines:
            lines[what] = ProgressLine(asked, f"assets {what}", "file")
        lines[what].expect(asked)
        lines[what].show(done)

    try:
        return open_sources(request.job, request.job_folder, watch)
    finally:
        for line in lines.values():
            line.close()


def order_pattern(store: Store, out: str, record: JobRecord, ledger: Ledger) -> ShardOrder:
    """The pattern of all orders. A new folder gets its job.yaml at once, a finished one a moment before a new commit."""
    order = ShardOrder.of(out, record.job, record.digest)
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


def _make(store: Store, pattern: Pattern, plan: SpanPlan, slots: Slots, keeper: LedgerKeeper, meter: Meter) -> int:
    """Makes the ranges, and shows how many scenes are done. The number of scenes made."""
    job = pattern.order.job
    tally = Tally(asked=plan.scenes)
    log_event("started", job=job.name, scenes=tally.asked, slots=slots.running)
    limits = Limits(slots, job.run.max_attempts, int(job.run.max_failure_share * job.scenes))
    if job.run.shard_size is not None:
        shards = group_shards(plan, job.run.shard_size)
    else:
        shards = deal_shards(plan, plan.scenes, job.range_size, lambda: slots.now().running)
    with contextlib.closing(ProgressLine(tally.asked, job.name)) as line:

        def follow(now: Tally) -> None:
            line.show(now.done + now.under_way, now.failed.total())
            keeper.add(now.take_commits())
            meter.show(now.counts(slots.now().running))

        Coordinator(store, pattern, limits, tally).run(shards, follow)
    return tally.made
