"""`verso run`: makes a job's dataset, or the part of it that is missing; with --dry-run, tells what that would be."""

import contextlib
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from schemas.dataset.commit import Ledger
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE
from schemas.dataset.shard import JobChange, ShardOrder
from schemas.errors import FingerprintError, InputError, OutputError, describe_seconds, plural
from schemas.job.job import Job
from services.job.job_file import describe_idle
from services.job.record import OWN, JobRecord, encode_job, record_job, refuse_foreign
from services.merge.merge import merge
from services.merge.tables import MergeResult, describe_sources, write_card
from services.run.coordinator import Coordinator, Limits
from services.run.lock import Lock, explain_lost_folder, hold_lock, read_holder, shows_life
from services.run.machine import usable_cores
from services.run.parts import find_parts
from services.run.progress import Meter, ProgressLine, Tally, event_log, log_event, serve, show_counts
from services.run.range_planner import MAX_SHARD, SpanPlan, deal_shards, find_lost, plan_spans
from services.run.ray_cluster import Slots, alive_nodes, join_cluster, open_ray, require_answer, share_gpus
from services.run.worker_entry import Pattern, terms_of_driver
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
class RunResult:
    """The merged dataset, the seconds that the run took, and the scenes made in it."""

    merged: MergeResult
    seconds: float
    made_now: int


def run_job(request: RunRequest, cluster: contextlib.AbstractContextManager[Slots] | None = None) -> RunResult:
    """Makes the missing scenes, then merges. Raises VersoError.

    `cluster` is entered if there is something to make; by default it is the one that the request asks for.
    """
    begun, made_now = time.monotonic(), 0
    catalogue, store = open_inputs(request.job, request.job_folder, request.out, request.address)
    refuse_foreign(store)
    meter = Meter(request.job.name)
    with (
        _leave_no_trace(store),
        explain_lost_folder(store.root),
        hold_lock(store) as lock,
        event_log(store.root),
        serve(meter, request.metrics),
    ):
        record = record_inputs(request.job, request.job_folder, catalogue, store)
        sweep(store, fenced=None)
        ledger = list_commits(store)
        for line in find_lost(ledger):
            print(f"verso: {line}", file=sys.stderr)
        plan = plan_spans(record.job, ledger, request.retry_failed)
        with contextlib.closing(LedgerKeeper(store, ledger)) as keeper:
            if plan.scenes:
                pattern = Pattern(order_pattern(store, record, ledger), catalogue, terms_of_driver())
                _announce(record.job.name, plan.scenes, ledger.committed, request.address)
                with cluster or open_ray(request.address, record.job.run.workers, request.sharing) as slots:
                    if request.address is not None:
                        pattern = join_cluster(store, lock.token, pattern)
                    made_now = make_missing(store, pattern, plan, slots, _follower(keeper, meter))
        meter.enter("merging")
        merged = finish(store, record, catalogue, lock)
        meter.enter("done")
    return RunResult(merged, time.monotonic() - begun, made_now)


@contextlib.contextmanager
def _leave_no_trace(store: Store) -> Iterator[None]:
    """Makes the output folder; where the block refuses the job before job.yaml is there, a folder is left as it was."""
    was_there = store.root is None or store.root.exists()
    store.prepare()
    try:
        yield
    except InputError:
        if store.root is not None and store.size(JOB_FILE) is None:
            for name in OWN & set(store.names("")):
                shutil.rmtree(store.root / name, ignore_errors=True)
            if not was_there:
                store.root.rmdir()
        raise


def open_inputs(job: Job, job_folder: Path, out: str, address: str | None = None) -> tuple[Catalogue, Store]:
    """The job's catalogue and its output folder, which need not be there yet; says which files are left out or doubtful.

    Raises what can be known before anything is written: a tier that cannot draw here, a cluster that does not answer. Shows
    how many files are listed and checked, which takes long where there are many new ones.
    """
    lines = describe_idle(job)
    require_answer(address)
    with show_counts("assets") as watch:
        require_tier(job.drawn)
        catalogue = open_sources(job, job_folder, watch)
        store = open_store(out)
    for line in (*lines, *catalogue.describe_left_out(), *catalogue.describe_doubts()):
        print(f"verso: {line}", file=sys.stderr)
    find_parts(job, catalogue)
    return catalogue, store


def record_inputs(job: Job, job_folder: Path, catalogue: Catalogue, store: Store) -> JobRecord:
    """The record of the job and its assets. Raises OutputError where the folder belongs to another job."""
    inputs = tuple(listing.sha256 for listing in catalogue.captures)
    return record_job(job, catalogue.digest, job_folder, inputs, out=store)


def order_pattern(store: Store, record: JobRecord, ledger: Ledger) -> ShardOrder:
    """The pattern of all orders. Workers write job.yaml where it is new or changes."""
    order = ShardOrder.of(store.name, record.job, record.digest)
    text = encode_job(record)
    before = b"" if store.size(JOB_FILE) is None else store.read(JOB_FILE)
    change = None if before == text else JobChange(before=before.decode(), after=text.decode())
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
            f"the commits of {store.name} were made by {len(stacks)} stacks ({', '.join(stack[:12] for stack in stacks[:3])}), "
            "and run.fingerprint is strict: set it to record to go on"
        )
    return stacks[0] if stacks else ""


def _announce(name: str, missing: int, committed: int, address: str | None) -> None:
    """Says what is to be made, and why the workers of this machine may take a while to begin."""
    there = f", {committed} are there" if committed else ""
    folder = os.environ.get("NUMBA_CACHE_DIR")  # noqa: TID251 - numba itself reads it nowhere else
    note = "" if address or are_kept(folder) else " (a first start compiles for up to a minute)"
    print(f"{name}: {plural(missing, 'scene')} to make{there}; starting the workers{note}", file=sys.stderr, flush=True)


def _follower(keeper: LedgerKeeper, meter: Meter) -> Callable[[Tally, int], None]:
    """What takes the tally as it changes, and the slots: new commits for the kept summary, counts for Prometheus."""

    def follow(tally: Tally, slots: int) -> None:
        keeper.add(tally.take_commits())
        meter.show(tally.counts(slots))

    return follow


def make_missing(
    store: Store, pattern: Pattern, plan: SpanPlan, slots: Slots, follow: Callable[[Tally, int], None]
) -> int:
    """Gives the missing ranges to Ray, and shows how many scenes are done. The number of scenes made."""
    job, tally = pattern.order.job, Tally(asked=plan.scenes)
    log_event("started", job=job.name, scenes=tally.asked, slots=slots.running)
    num_gpus = share_gpus([node["Resources"] for node in alive_nodes()], slots.running, job.run)
    limits = Limits(slots, job.run.max_attempts, int(job.run.max_failure_share * job.scenes), num_gpus)
    shards = deal_shards(plan, plan.scenes, job.range_size, lambda: slots.now().running, job.run.shard_size)
    with contextlib.closing(ProgressLine(tally.asked, job.name)) as line:

        def show(now: Tally) -> None:
            line.show(now.done + now.under_way, now.failed.total())
            follow(now, slots.now().running)

        Coordinator(store, pattern, limits, tally).run(shards, show)
    return tally.made


def finish(store: Store, record: JobRecord, catalogue: Catalogue, lock: Lock) -> MergeResult:
    """Brings job.yaml up to date, merges, and writes the card. Raises RunError where the lock was lost."""
    job, text = record.job, encode_job(record)
    if store.size(JOB_FILE) is None or store.read(JOB_FILE) != text:
        store.put(JOB_FILE, text)
    merged = merge(store, job.first_scene, job.stop_scene, lock.require_held)
    write_card(store, record, catalogue, merged)
    log_event("finished", job=job.name, digest=merged.digest)
    return merged


# ------------------------------------------------------------------------------------------------ --dry-run

TIMED_SCENES = 3
LONGEST_S = 10.0
"""No further scene is timed after so long, but for the first, which compiles."""


def describe_plan(request: RunRequest) -> list[str]:
    """Lines that tell what a run would do; changes nothing. Raises what the run would raise before its first scene."""
    from workers.shard.framing import require_framed  # loads what plans scenes, which a run leaves to its workers

    catalogue, store = open_inputs(request.job, request.job_folder, request.out, request.address)
    _require_writable(store)
    refuse_foreign(store)
    job = record_inputs(request.job, request.job_folder, catalogue, store).job
    if store.size(JOB_FILE) is None:
        require_framed(job, catalogue)
    ledger = list_commits(store)
    left = plan_spans(job, ledger, request.retry_failed).scenes
    shards = job.run.shard_size or f"up to {MAX_SHARD}"
    there = f"{ledger.committed} of {job.scenes} scenes are there"
    return [
        f"job {job.name}: {_describe_scenes(job)}, seed {job.seed}",
        f"categories: {', '.join(f'{name} {weight:g}' for name, weight in sorted(job.categories.items()))}",
        *describe_sources(catalogue),
        *catalogue.describe_doubts(),
        f"out: {request.out}, ranges of {job.range_size}, shards of {shards} scenes",
        *_describe_holder(store),
        f"{there}, {left} are left to make" if left else f"{there}: nothing is left to make",
        *(_describe_cost(job, catalogue, left, request.address is None) if left else ()),
    ]


def _describe_scenes(job: Job) -> str:
    """What a job makes, in a few words."""
    ids = f"{job.first_scene} to {job.stop_scene - 1}"
    if job.captures is None:
        return f"scenes {ids}, {plural(job.pairs_per_scene, 'pair')} each"
    kind = "in folders" if job.captures.folders else f"virtual, of {job.captures.simulate.views} views"
    return f"captures {ids}, {kind}, at most {job.pairs_per_scene} pairs each"


def _require_writable(store: Store) -> None:
    """Raises OutputError where a folder of this machine could not be made or written."""
    if store.root is None:
        return
    folder = next(place for place in (store.root, *store.root.parents) if place.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(
            f"{store.name}: {folder} cannot be written: choose another --out, or change its owner or mode"
        )


def _describe_holder(store: Store) -> Iterator[str]:
    holder = read_holder(store)
    if holder is not None and shows_life(store, holder):
        yield f"another run is at work there: process {holder.pid} on {holder.host}; a second one waits for its end"


def _describe_cost(job: Job, catalogue: Catalogue, left: int, here: bool) -> Iterator[str]:
    """What the scenes that are left take, `here` with this machine's cores; nothing for captures."""
    cost = None if job.captures is not None else measure_scene(job, catalogue)
    if isinstance(cost, str):
        yield f"what that takes is not known, for the first scenes cannot be made: {cost}"
    elif cost is not None:
        seconds, size = cost
        cores = job.run.workers or usable_cores()
        where = f", {describe_seconds(left * seconds / cores)} with {cores} workers here" if here else ""
        yield (
            f"that takes about {describe_seconds(left * seconds)} of processor{where}, "
            f"and {left * size / 1e6:,.0f} MB ({seconds * 1e3:.0f} ms and {size / 1e6:.2f} MB a scene, measured now)"
        )


def measure_scene(job: Job, catalogue: Catalogue) -> tuple[float, float] | str | None:
    """(seconds of processor, bytes of files) of a scene, made in memory, the first one apart, which compiles.

    Where none can be made, why the last could not; None where that is a bug. Scenes that fail count with their time.
    """
    from workers.scene.context import open_worker  # load GL and PyBullet
    from workers.shard.run_shard import run_scene
    from workers.stopwatch import Stopwatch

    context = open_worker(job, catalogue)
    took, sizes, why = [], [], None
    for number in range(min(1 + TIMED_SCENES, job.scenes)):
        began = time.process_time()
        try:
            output = run_scene(context, job.first_scene + number, Stopwatch())
        except Exception:  # a bug: the run goes on after it and tells it
            continue
        took.append(time.process_time() - began)
        sizes.append(sum(len(file.data) for file in output.files))
        why = next((f"{row['reason']}: {row['detail']}" for row in output.rows.get("failures", ())), why)
        if sum(took[1:]) > LONGEST_S:
            break
    made = [size for size in sizes if size]
    times = took[1:] or took
    return (sum(times) / len(times), sum(made) / len(made)) if made else why
