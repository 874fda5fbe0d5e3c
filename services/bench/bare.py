"""Plain processes without Ray: what this machine gives to several workers at once.

Two processes that share nothing but the machine seldom do twice the work of one: cores share caches, memory and clock,
and are often two threads of one core. No scheduler can gain more than plain processes do.
"""

import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from schemas.dataset.commit import Span
from schemas.errors import RunError
from schemas.job.job import Job
from services.bench.ratios import Lap
from services.bench.stages import open_workbench

WARM_UP = 8
"""Scenes that each process makes first."""


@dataclass(frozen=True, eq=False)
class Processes:
    """Warm processes, each a pool of one with a folder of its own and, in turn, a core of its own."""

    job: Job
    job_folder: Path
    folder: Path
    pools: Sequence[ProcessPoolExecutor]
    runs: Counter[int] = field(default_factory=Counter)

    def run(self, count: int, first: int, stop: int) -> list[Lap]:
        """The first `count` of them make scenes [first, stop) at the same time, all of them the same scenes."""
        out = [self.folder / f"bare{number}" / str(self.runs[number]) for number in range(count)]
        self.runs.update(range(count))
        laps = [
            pool.submit(_work, self.job, self.job_folder, folder, first, stop)
            for pool, folder in zip(self.pools[:count], out, strict=True)
        ]
        try:
            return [lap.result() for lap in laps]
        except BrokenProcessPool as error:
            raise RunError("a plain process of the benchmark died; its last words stand above") from error


@contextmanager
def bare_processes(job: Job, job_folder: Path, folder: Path, count: int) -> Iterator[Processes]:
    """That many processes, each of which has made its first scenes."""
    fresh, cores = multiprocessing.get_context("spawn"), sorted(os.sched_getaffinity(0))
    with ExitStack() as running:
        pools = [
            running.enter_context(
                ProcessPoolExecutor(1, fresh, initializer=_pin, initargs=(cores[number % len(cores)],))
            )
            for number in range(count)
        ]
        processes = Processes(job, job_folder, folder, pools)
        processes.run(count, job.first_scene, job.first_scene + WARM_UP)
        yield processes


def _pin(core: int) -> None:
    os.sched_setaffinity(0, {core})


def _work(job: Job, job_folder: Path, folder: Path, first: int, stop: int) -> Lap:
    """Make and commit these scenes into a new folder."""
    bench = open_workbench(job, job_folder, folder)
    wall, cpu, made = time.perf_counter(), time.process_time(), 0
    for start in range(first, stop, job.run.range_size):
        made += bench.run(Span(start=start, stop=min(start + job.run.range_size, stop))).scenes
    return Lap(made, time.perf_counter() - wall, time.process_time() - cpu, {})
