"""Memory and pace of one worker over many scenes, and several workers against one.

- Scaling: several workers against one through the coordinator, and several plain processes against one.

Two processes that share nothing but the machine seldom do twice the work of one: cores share caches, memory and clock,
and are often two threads of one core. No scheduler can gain more than plain processes do, and these no more than empty
loops, which use nothing but cores: two virtual cores may be worth less than two of the first.
"""

import multiprocessing
import os
import time
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from schemas.dataset.commit import Span
from schemas.dataset.shard import ShardOrder
from schemas.errors import RunError
from schemas.job.job import Job
from services.bench.figures import Lap, Spread, by_clock, by_processor, growth, idle_share, slope_ratio
from services.bench.measure import count_for, open_workbench, run_process
from services.run.coordinator import Coordinator, Limits
from services.run.joining import Pattern, terms_of_driver
from services.run.metrics import Tally
from services.run.range_planner import deal_shards, plan_ranges
from services.run.ray_cluster import PREFETCH, Slots, private_ray
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.store.local import LocalStore

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


WARM_UP = 8
"""Scenes that each plain process makes first."""

LOOP_S = 2.0
"""Time of an empty loop."""


def measure_scaling(
    job: Job, job_folder: Path, folder: Path, workers: int, scenes: int, rounds: int = 3
) -> dict[str, Any]:
    """One worker, all workers, one process, all processes, and again; always the same scenes, into new folders.

    Ranges and shards are those of a run of that many scenes. Everything is warm before: Ray's start, imports, the OpenGL
    context and its shaders are in no figure. `ray`: workers through the coordinator; `bare`: plain processes, each on a core
    of its own; `loops`: the speed-up of empty loops in these, the machine's own. ray_share: the share of the slots' time
    without a shard, the uneven end of the last shards included; ray_share_one: the same with one worker, which has no such
    end. share_of_bare: Ray's speed-up over that of plain processes.
    """
    job = job.model_copy(update={"scenes": scenes})
    counts = (1, workers)
    ray: dict[int, list[tuple[Lap, float]]] = {count: [] for count in counts}
    bare: dict[int, list[Lap]] = {count: [] for count in counts}
    loops: dict[int, list[Lap]] = {count: [] for count in counts}
    each = Span(start=job.first_scene, stop=job.first_scene + max(1, scenes // workers))
    drive = _RayDrive(job, open_catalogue(job.assets, job_folder, tuple(job.categories)), folder, workers)
    with private_ray(workers), plain_processes(job, job_folder, folder, workers) as processes:
        drive.run("warm", workers, 4 * workers * job.range_size)
        for number in range(rounds):
            for count in counts:
                ray[count].append(drive.run(f"{number}-{count}", count, scenes))
            for count in counts:
                bare[count].append(_together(processes.run(f"{number}-{count}", count, each)))
            for count in counts:
                loops[count].append(_together(processes.loop(count, LOOP_S)))
    gain = gain_of(*([lap for lap, _ in ray[count]] for count in counts))
    reference = gain_of(bare[1], bare[workers])
    return {
        "workers": workers,
        "range": job.range_size,
        "ray": gain,
        "bare": reference,
        "loops": asdict(slope_ratio(loops[1], loops[workers])),
        "ray_share": asdict(Spread.of([idle for _, idle in ray[workers]])),
        "ray_share_one": asdict(Spread.of([idle for _, idle in ray[1]])),
        "share_of_bare": gain["speedup"]["median"] / reference["speedup"]["median"],
    }


def _together(laps: Sequence[Lap]) -> Lap:
    """The lap of processes that start together: it lasts until the last one's end."""
    return Lap(sum(lap.scenes for lap in laps), max(lap.wall_s for lap in laps), sum(lap.cpu_s for lap in laps), {})


def gain_of(one: Sequence[Lap], several: Sequence[Lap]) -> dict[str, Any]:
    """The gain of several at once over one, from laps in pairs; a lap lasts from the first start to the last end.

    speedup: ratio of the paces; inflation: ratio of the processor time a scene, the cost of sharing caches, memory and clock,
    without waiting.
    """
    return {
        "scenes": several[0].scenes,
        "one_scenes_per_s": Spread.of([1.0 / by_clock(lap) for lap in one]).median,
        "all_scenes_per_s": Spread.of([1.0 / by_clock(lap) for lap in several]).median,
        "speedup": asdict(slope_ratio(one, several)),
        "inflation": asdict(slope_ratio(several, one, by_processor)),
    }


@dataclass(frozen=True, eq=False)
class Processes:
    """Warm processes without Ray, each a pool of one with a folder of its own and, in turn, a core of its own."""

    job: Job
    job_folder: Path
    folder: Path
    pools: Sequence[ProcessPoolExecutor]

    def run(self, name: str, count: int, span: Span) -> list[Lap]:
        """The first `count` of them make these scenes at the same time, all of them the same scenes."""
        return self._laps(
            pool.submit(run_process, self.job, self.job_folder, self.folder / f"bare{number}" / name, span)
            for number, pool in enumerate(self.pools[:count])
        )

    def loop(self, count: int, seconds: float) -> list[Lap]:
        """The first `count` of them turn an empty loop at the same time."""
        return self._laps(pool.submit(count_for, seconds) for pool in self.pools[:count])

    def _laps(self, begun: Iterable[Future[Lap]]) -> list[Lap]:
        """The laps of what was begun, all of it before one is waited for."""
        under_way = list(begun)
        try:
            return [lap.result() for lap in under_way]
        except BrokenProcessPool as error:
            raise RunError("a plain process of the benchmark died; its last words stand above") from error


@contextmanager
def plain_processes(job: Job, job_folder: Path, folder: Path, count: int) -> Iterator[Processes]:
    """That many processes, each of which has made its first scenes. They never load this module, and so never Ray."""
    fresh, cores = multiprocessing.get_context("spawn"), sorted(os.sched_getaffinity(0))
    pins = [{cores[number % len(cores)]} for number in range(count)]
    with ExitStack() as running:
        executors = [ProcessPoolExecutor(1, fresh, initializer=os.sched_setaffinity, initargs=(0, pin)) for pin in pins]
        processes = Processes(job, job_folder, folder, [running.enter_context(pool) for pool in executors])
        processes.run("warm", count, Span(start=job.first_scene, stop=job.first_scene + WARM_UP))
        yield processes


@dataclass(frozen=True)
class _RayDrive:
    """Runs of the coordinator on a running Ray."""

    job: Job
    catalogue: Catalogue
    folder: Path
    workers: int

    def run(self, name: str, slots: int, count: int) -> tuple[Lap, float]:
        """A lap of that many scenes, and the share of the slots' time without a shard."""
        out, size, first = self.folder / name, self.job.range_size, self.job.first_scene
        spans = (Span(start=start, stop=stop) for start, stop in plan_ranges(first, first + count, size, []))
        store = LocalStore(out)
        store.prepare()
        tally = Tally(asked=count)
        # The other slot could start a waiting shard, so one worker gets one shard at a time.
        in_flight = PREFETCH * slots if slots == self.workers else slots
        limits = Limits(Slots(slots, in_flight), 1, count)
        pattern = Pattern(ShardOrder.of(str(out), self.job, "bench"), self.catalogue, terms_of_driver())
        begun = time.perf_counter()
        Coordinator(store, pattern, limits, tally).run(deal_shards(spans, count, size, lambda: slots))
        seconds = time.perf_counter() - begun
        idle = idle_share(tally.shard_wall_s, slots, seconds)
        return Lap(tally.made, seconds, tally.shard_cpu_s, {}), idle
