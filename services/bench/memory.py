"""Memory and pace of one worker over many scenes, in a process of its own."""

import multiprocessing
from bisect import bisect_left
from concurrent.futures import ProcessPoolExecutor
from itertools import accumulate
from pathlib import Path
from statistics import median
from typing import NamedTuple

from schemas.job.job import Job
from services.bench.ratios import by_processor, growth
from services.bench.stages import open_workbench

SETTLED = 200
"""Scenes after which every cache is full and every shader compiled."""


class Sample(NamedTuple):
    """One range: its scenes, resident MB after it, and seconds of processor a scene."""

    scenes: int
    mb: float
    cpu_s: float


def measure_memory(job: Job, job_folder: Path, folder: Path, scenes: int) -> dict[str, float]:
    """Make that many scenes in one fresh worker; returns the figures of `summarise`."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return summarise(*pool.submit(sample_memory, job, job_folder, folder, scenes).result())


def sample_memory(job: Job, job_folder: Path, folder: Path, scenes: int) -> tuple[list[Sample], float]:
    """A sample for each range, and the peak MB of this process."""
    bench = open_workbench(job, job_folder, folder)
    stop, samples = job.first_scene + scenes, []
    while bench.next_scene < stop:
        span = bench.next_span(min(job.range_size, stop - bench.next_scene))
        lap = bench.run(span)
        samples.append(Sample(len(span.scene_ids), resident_mb("VmRSS"), by_processor(lap)))
    return samples, resident_mb("VmHWM")


def resident_mb(field: str) -> float:
    """Resident memory of this process, MB: `VmRSS` now, `VmHWM` the peak; a child inherits `ru_maxrss` from its parent."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) * 1024 / 1e6


def summarise(samples: list[Sample], peak_mb: float) -> dict[str, float]:
    """Resident memory and pace over the scenes; below ten times `SETTLED` scenes, the first tenth counts as settling.

    grown: growth of the memory since it settled, 0.05 for 5 %. peak_mb: the peak of the process. first_ms and last_ms: of
    processor a scene in the first `settled_after` scenes and in as many at the end, medians over ranges, which other
    processes disturb little; last_to_first: their ratio.
    """
    counts, megabytes, paces = zip(*samples, strict=True)
    scenes = list(accumulate(counts))
    settled = bisect_left(scenes, min(SETTLED, scenes[-1] // 10 or 1))
    window = settled + 1
    return {
        "scenes": scenes[-1],
        "settled_after": scenes[settled],
        "settled_mb": megabytes[settled],
        "last_mb": megabytes[-1],
        "peak_mb": max(peak_mb, *megabytes),
        "grown": megabytes[-1] / megabytes[settled] - 1.0,
        "first_ms": median(paces[:window]) * 1e3,
        "last_ms": median(paces[-window:]) * 1e3,
        "last_to_first": 1.0 + growth(paces, window),
    }
