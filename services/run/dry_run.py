"""`verso run --dry-run`: what a run would refuse, what is there, what is left, and about what that costs. Changes nothing."""

import os
import time

from schemas.dataset.commit import Ledger
from schemas.errors import OutputError, describe_seconds
from schemas.job.job import Job
from services.job.record import record_job, refuse_foreign
from services.merge.tables import describe_sources
from services.run.lock import read_holder, shows_life
from services.run.machine import usable_cores
from services.run.range_planner import MAX_SHARD, plan_spans
from services.run.run_job import RunRequest, open_inputs
from workers.assets.catalogue import Catalogue
from workers.scene.context import Stopwatch, open_worker
from workers.shard.run_shard import run_scene
from workers.store.ledger import list_commits
from workers.store.store import Store

TIMED_SCENES = 3
LONGEST_S = 10.0
"""No further scene is timed after so long, but for the first, which compiles."""


def describe_plan(request: RunRequest) -> list[str]:
    """Lines that tell what a run would do. Raises what the run would raise before its first scene."""
    catalogue, store = open_inputs(request)
    _require_writable(store)
    refuse_foreign(store)
    inputs = tuple(listing.sha256 for listing in catalogue.captures)
    job = record_job(request.job, catalogue.digest, request.job_folder, inputs, out=store).job
    ledger = list_commits(store)
    left = plan_spans(job, ledger, request.retry_failed).scenes
    shards = job.run.shard_size or f"up to {MAX_SHARD}"
    return [
        f"job {job.name}: {describe_scenes(job)}, seed {job.seed}",
        f"categories: {', '.join(f'{name} {weight:g}' for name, weight in sorted(job.categories.items()))}",
        *describe_sources(catalogue),
        *catalogue.describe_doubts(),
        f"out: {request.out}, ranges of {job.range_size}, shards of {shards} scenes",
        *_describe_holder(store),
        *_describe_left(request, job, catalogue, ledger, left),
    ]


def describe_scenes(job: Job) -> str:
    """What a job makes, in a few words."""
    ids = f"{job.first_scene} to {job.stop_scene - 1}"
    if job.captures is None:
        return f"scenes {ids}, {job.pairs_per_scene} pair{'s' * (job.pairs_per_scene > 1)} each"
    virtual = f"virtual, of {job.captures.simulate.views} views"
    return (
        f"captures {ids}, {'in folders' if job.captures.folders else virtual}, at most {job.pairs_per_scene} pairs each"
    )


def _require_writable(store: Store) -> None:
    """Raises OutputError where a folder of this machine could not be made or written."""
    if store.root is None:
        return
    folder = next(place for place in (store.root, *store.root.parents) if place.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(
            f"{store.name}: {folder} cannot be written: choose another --out, or change its owner or mode"
        )


def _describe_holder(store: Store) -> list[str]:
    holder = read_holder(store)
    if holder is None or not shows_life(store, holder):
        return []
    return [f"another run is at work there: process {holder.pid} on {holder.host}; a second one waits for its end"]


def _describe_left(request: RunRequest, job: Job, catalogue: Catalogue, ledger: Ledger, left: int) -> list[str]:
    there = f"{ledger.committed} of {job.scenes} scenes are there"
    if not left:
        return [f"{there}: nothing is left to make"]
    lines = [f"{there}, {left} are left to make"]
    if job.captures is None and (cost := measure_scene(job, catalogue)) is not None:
        seconds, size = cost
        cores = job.run.workers or usable_cores()
        where = f" of processor, {describe_seconds(left * seconds / cores)} with {cores} workers here"
        lines.append(
            f"that takes about {describe_seconds(left * seconds)}{where if request.address is None else ' of processor'}, "
            f"and {left * size / 1e6:,.0f} MB ({seconds * 1e3:.0f} ms and {size / 1e6:.2f} MB a scene, measured now)"
        )
    return lines


def measure_scene(job: Job, catalogue: Catalogue) -> tuple[float, float] | None:
    """(seconds of processor, bytes of files) of a scene, made in memory, the first one apart, which compiles; None where none is.

    Scenes that fail count with their time.
    """
    context = open_worker(job, catalogue)
    took, sizes = [], []
    for number in range(min(1 + TIMED_SCENES, job.scenes)):
        began = time.process_time()
        try:
            output = run_scene(context, job.first_scene + number, Stopwatch())
        except Exception:  # a bug: the run goes on after it and tells it
            continue
        took.append(time.process_time() - began)
        sizes.append(sum(len(file.data) for file in output.files))
        if sum(took[1:]) > LONGEST_S:
            break
    made = [size for size in sizes if size]
    if not made:
        return None
    times = took[1:] or took
    return sum(times) / len(times), sum(made) / len(made)
