"""Memory and pace of one worker over many scenes, in a process of its own."""

import multiprocessing
from bisect import bisect_left
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from statistics import median

from schemas.job.job import Job
from services.bench.machine import peak_resident_mb, resident_mb
from services.bench.ratios import by_processor, growth
from services.bench.stages import open_workbench

SETTLED = 200
"""Scenes after which every cache is full and every shader compiled."""


@dataclass(frozen=True)
class Sample:
    """One range: its scenes, resident MB after it, and seconds of processor a scene."""

    scenes: int
    mb: float
    cpu_s: float


@dataclass(frozen=True)
class Memory:
    """Resident memory, MB, and pace over the scenes.

    grown: growth of the memory since it settled, 0.05 for 5 %. peak_mb: the peak of the process. first_ms and last_ms: of
    processor a scene in the first `settled_after` scenes and in as many at the end, medians over ranges, which other
    processes disturb little; last_to_first: their ratio.
    """

    scenes: int
    settled_after: int
    settled_mb: float
    last_mb: float
    peak_mb: float
    grown: float
    first_ms: float
    last_ms: float
    last_to_first: float


def measure_memory(job: Job, job_folder: Path, folder: Path, scenes: int) -> Memory:
    """Make that many scenes in one fresh worker."""
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=fresh) as pool:
        samples, peak = pool.submit(sample_memory, job, job_folder, folder, scenes).result()
    return describe(samples, peak)


def sample_memory(job: Job, job_folder: Path, folder: Path, scenes: int) -> tuple[list[Sample], float]:
    """A sample for each range, and the peak MB of this process."""
    bench = open_workbench(job, job_folder, folder)
    stop, samples = job.first_scene + scenes, []
    while bench.next_scene < stop:
        span = bench.next_span(min(job.run.range_size, stop - bench.next_scene))
        lap = bench.run(span)
        samples.append(Sample(len(span.scene_ids), resident_mb(), by_processor(lap)))
    return samples, peak_resident_mb()


def describe(samples: list[Sample], peak_mb: float) -> Memory:
    """The figures of a run; with fewer than ten times `SETTLED` scenes, the first tenth counts as settling."""
    scenes = list(accumulate(sample.scenes for sample in samples))
    settled = bisect_left(scenes, min(SETTLED, scenes[-1] // 10 or 1))
    window = settled + 1
    megabytes, paces = [sample.mb for sample in samples], [sample.cpu_s for sample in samples]
    return Memory(
        scenes=scenes[-1],
        settled_after=scenes[settled],
        settled_mb=megabytes[settled],
        last_mb=megabytes[-1],
        peak_mb=max(peak_mb, *megabytes),
        grown=megabytes[-1] / megabytes[settled] - 1.0,
        first_ms=median(paces[:window]) * 1e3,
        last_ms=median(paces[-window:]) * 1e3,
        last_to_first=1.0 + growth(paces, window),
    )
