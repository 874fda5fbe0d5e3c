"""Scaling: several workers against one through the coordinator, and several plain processes against one."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from schemas.dataset.commit import Span
from schemas.job.job import Job
from services.bench.bare import bare_processes
from services.bench.ratios import Lap, Spread, by_processor, idle_share
from services.bench.stages import bench_order
from services.run.coordinator import Coordinator, Limits, Tally
from services.run.range_planner import MAX_SHARD, group_shards
from services.run.ray_cluster import PREFETCH, private_ray
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.store.local import LocalStore


@dataclass(frozen=True)
class Gain:
    """The gain of several at once over one, over rounds.

    speedup: ratio of the paces; inflation: ratio of the processor time a scene, the cost of sharing caches, memory and clock,
    without waiting.
    """

    scenes: int
    one_scenes_per_s: float
    all_scenes_per_s: float
    speedup: Spread
    inflation: Spread

    @classmethod
    def of(cls, one: Sequence[Lap], several: Sequence[Lap]) -> "Gain":
        """The gain from laps of one and of all, in pairs; a lap lasts from the first scene's start to the last one's end."""
        pairs = list(zip(one, several, strict=True))
        return cls(
            scenes=several[0].scenes,
            one_scenes_per_s=Spread.of([lap.scenes / lap.wall_s for lap in one]).median,
            all_scenes_per_s=Spread.of([lap.scenes / lap.wall_s for lap in several]).median,
            speedup=Spread.of([a.slope_s / b.slope_s for a, b in pairs]),
            inflation=Spread.of([by_processor(b) / by_processor(a) for a, b in pairs]),
        )


@dataclass(frozen=True)
class Scaling:
    """`ray`: workers through the coordinator; `bare`: plain processes, each on a core of its own.

    ray_share: the share of the slots' time without a shard, the uneven end of the last shards included; ray_share_one: the
    same with one worker, which has no such end. share_of_bare: Ray's speed-up over that of plain processes.
    """

    workers: int
    shard: int
    ray: Gain
    bare: Gain
    ray_share: Spread
    ray_share_one: Spread
    share_of_bare: float


def measure_scaling(
    job: Job, job_folder: Path, folder: Path, workers: int, scenes: int, rounds: int = 3, shard: int = MAX_SHARD
) -> Scaling:
    """One worker, all workers, one process, all processes, and again; always the same scenes, into new folders.

    Everything is warm before: Ray's start, imports, the OpenGL context and its shaders are in no figure.
    """
    catalogue = open_catalogue(job.assets, job_folder, tuple(job.categories))
    drive = _RayDrive(job, catalogue, folder, workers)
    ray: dict[int, list[tuple[Lap, float]]] = {1: [], workers: []}
    bare: dict[int, list[Lap]] = {1: [], workers: []}
    each = max(1, scenes // workers)
    with ExitStack() as running:
        running.enter_context(private_ray(workers))
        processes = running.enter_context(bare_processes(job, job_folder, folder, workers))
        drive.run("warm", workers, 4 * workers * job.run.range_size, job.run.range_size)
        for number in range(rounds):
            for count in (1, workers):
                ray[count].append(drive.run(f"{number}-{count}", count, scenes, shard))
            for count in (1, workers):
                laps = processes.run(count, job.first_scene, job.first_scene + each)
                bare[count].append(_together(laps))
    gain = Gain.of(*([lap for lap, _ in ray[count]] for count in (1, workers)))
    reference = Gain.of(bare[1], bare[workers])
    return Scaling(
        workers=workers,
        shard=shard,
        ray=gain,
        bare=reference,
        ray_share=Spread.of([idle for _, idle in ray[workers]]),
        ray_share_one=Spread.of([idle for _, idle in ray[1]]),
        share_of_bare=gain.speedup.median / reference.speedup.median,
    )


def _together(laps: Sequence[Lap]) -> Lap:
    """One lap of processes that started together, until the last one's end."""
    return Lap(sum(lap.scenes for lap in laps), max(lap.wall_s for lap in laps), sum(lap.cpu_s for lap in laps), {})


@dataclass(frozen=True)
class _RayDrive:
    """Runs of the coordinator on a running Ray."""

    job: Job
    catalogue: Catalogue
    folder: Path
    workers: int

    def run(self, name: str, slots: int, count: int, shard_size: int) -> tuple[Lap, float]:
        """A lap of that many scenes, and the share of the slots' time without a shard."""
        out, size, first = self.folder / name, self.job.run.range_size, self.job.first_scene
        store = LocalStore(out)
        store.prepare()
        spans = [Span(start=s, stop=min(s + size, first + count)) for s in range(first, first + count, size)]
        tally = Tally(asked=count)
        # The other slot could start a waiting shard, so one worker gets one shard at a time.
        limits = Limits(PREFETCH * slots if slots == self.workers else slots, 1, count)
        begun = time.perf_counter()
        Coordinator(store, bench_order(self.job, out), self.catalogue, limits, tally).run(
            group_shards(spans, shard_size)
        )
        seconds = time.perf_counter() - begun
        idle = idle_share(tally.shard_wall_s, slots, seconds)
        return Lap(tally.made, seconds, tally.shard_cpu_s, {}), idle
