"""Memory and speed of one worker over many scenes, in a process of its own."""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from schemas.job import Job
from services.bench.machine import resident_mb
from services.bench.ratios import growth
from services.bench.stages import open_workbench

SETTLED = 200
"""After so many scenes every cache is full and every shader made."""


@dataclass(frozen=True)
class Memory:
    """Resident memory, MB, and pace over the scenes.

    grown: of the memory since it settled; slowed: of the time for a scene from the first `settled_after` to as many at
    the end; shares, 0.05 being 5 % more.
    """

    scenes: int
    settled_after: int
    settled_mb: float
    last_mb: float
    peak_mb: float
    grown: float
    slowed: float


def measure_memory(job: Job, job_folder: Path, folder: Path, scenes: int) -> Memory:
    """Make so many scenes in one fresh worker."""
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=fresh) as pool:
        samples = pool.submit(sample_memory, job, job_folder, folder, scenes).result()
    return describe(samples, scenes)


def sample_memory(job: Job, job_folder: Path, folder: Path, scenes: int) -> list[tuple[float, float]]:
    """(resident MB, seconds per scene) after each range."""
    bench = open_workbench(job, job_folder, folder)
    samples = []
    while bench.next_scene < job.first_scene + scenes:
        begun = time.perf_counter()
        lap = bench.run(bench.next_span(job.run.range_size))
        samples.append((resident_mb(), (time.perf_counter() - begun) / lap.scenes))
    return samples


def describe(samples: list[tuple[float, float]], scenes: int) -> Memory:
    """The figures of a run; with fewer than ten times `SETTLED` scenes, the first tenth counts as settling."""
    settled = max(1, len(samples) * min(SETTLED, scenes // 10 or 1) // scenes)
    megabytes, paces = [mb for mb, _ in samples], [pace for _, pace in samples]
    return Memory(
        scenes=scenes,
        settled_after=scenes * settled // len(samples),
        settled_mb=megabytes[settled - 1],
        last_mb=megabytes[-1],
        peak_mb=max(megabytes),
        grown=megabytes[-1] / megabytes[settled - 1] - 1.0,
        slowed=growth(paces, settled),
    )
