"""Our side of the benchmark: whole scenes of a job by the production code, onto a real disk."""

import time
from dataclasses import dataclass
from pathlib import Path

from schemas.dataset.commit import Span
from schemas.dataset.shard import ShardOrder
from schemas.errors import RunError, SceneError
from schemas.job.job import Job
from services.bench.ratios import Lap
from workers.assets.catalogue import open_catalogue
from workers.geometry.jit import compile_planned
from workers.pipeline.context import WorkerContext, open_worker
from workers.pipeline.make_scene import Scene, make_scene
from workers.pipeline.run_shard import run_ranges
from workers.pipeline.stopwatch import Stopwatch
from workers.render.raster.context import require_device
from workers.store.commit import committed_files, read_record
from workers.store.local import LocalStore

LOOP_TURNS = 10_000
"""Turns of an empty loop, 0.2 ms, between two looks at the clock."""


@dataclass(eq=False)
class Workbench:
    """A worker's context and a dataset's folder, ready to make one range after another."""

    context: WorkerContext
    store: LocalStore
    order: ShardOrder
    next_scene: int

    def next_span(self, scenes: int) -> Span:
        """The next range, of new scenes, so that no shape is cached already."""
        span = Span(start=self.next_scene, stop=self.next_scene + scenes)
        self.next_scene = span.stop
        return span

    def run(self, *spans: Span) -> Lap:
        """Make and commit ranges. Raises RunError where none of their scenes could be made."""
        watch = Stopwatch()
        wall, cpu = time.perf_counter(), time.process_time()
        reports = run_ranges(self.context, self.store, self.order, spans, watch)
        made = sum(report.made for report in reports)
        lap = Lap(made, time.perf_counter() - wall, time.process_time() - cpu, watch.seconds)
        if not made:
            failed = {reason for report in reports for reason in report.failed}
            raise RunError(
                f"none of the scenes {spans[0].start} to {spans[-1].stop - 1} could be made: {', '.join(sorted(failed))}"
            )
        return lap

    def files(self, span: Span) -> dict[str, bytes]:
        """The bytes of every file that the range's commit names, by path."""
        record = read_record(self.store, span.start)
        assert record is not None
        return {
            entry.path: (self.store.root / entry.path).read_bytes() for entry in committed_files(self.store, record)
        }


def open_workbench(job: Job, job_folder: Path, out: Path) -> Workbench:
    """A workbench for the job's scenes in an empty folder."""
    catalogue = open_catalogue(job.assets, job_folder, tuple(job.categories))
    store = LocalStore(out)
    store.prepare()
    compile_planned()
    context = open_worker(job, catalogue)
    require_device(context.renderer.name, job.run.device)
    return Workbench(context, store, ShardOrder.of(str(out), job, "bench"), job.first_scene)


def make_in_memory(context: WorkerContext, span: Span) -> list[Scene]:
    """The scenes that can be made, as input for the other sides. Raises RunError for none."""
    made, reason = [], ""
    for scene_id in span.scene_ids:
        try:
            made.append(make_scene(context, scene_id, Stopwatch()))
        except SceneError as error:
            reason = str(error)
    if not made:
        raise RunError(f"none of the scenes {span.start} to {span.stop - 1} could be made: {reason}")
    return made


def run_process(job: Job, job_folder: Path, folder: Path, span: Span) -> Lap:
    """A plain process's part: make and commit a span into a new folder, range by range."""
    bench = open_workbench(job, job_folder, folder)
    starts = range(span.start, span.stop, job.range_size)
    return bench.run(*(Span(start=start, stop=min(start + job.range_size, span.stop)) for start in starts))


def count_for(seconds: float) -> Lap:
    """So many turns of an empty loop as `scenes`: what the core gives to one that uses no memory and waits for nothing."""
    turns, wall, cpu = 0, time.perf_counter(), time.process_time()
    while time.perf_counter() < wall + seconds:
        for _ in range(LOOP_TURNS):
            pass
        turns += LOOP_TURNS
    return Lap(turns, time.perf_counter() - wall, time.process_time() - cpu, {})
