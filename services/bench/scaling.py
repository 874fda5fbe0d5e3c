"""Several workers against one, through the real coordinator."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from schemas.commit import Span
from schemas.job import Job
from services.bench.ratios import Spread, idle_share
from services.bench.stages import bench_order
from services.coordinator import Limits, Tally, run_spans
from services.ray_cluster import PREFETCH, private_ray
from services.run import USUAL_SHARD, group_shards
from workers.assets.catalogue import open_catalogue
from workers.store.local import LocalStore


@dataclass(frozen=True)
class Scaling:
    """`speedup`: how many times one worker's pace `workers` have; `ray_share`: of the slots' time, what no shard used."""

    workers: int
    scenes: int
    shard: int
    one_scenes_per_s: float
    all_scenes_per_s: float
    speedup: Spread
    ray_share: Spread


def measure_scaling(
    job: Job, job_folder: Path, folder: Path, workers: int, scenes: int, rounds: int = 2, shard: int = USUAL_SHARD
) -> Scaling:
    """One worker, all workers, one, all ...; each time the same scenes into a new folder, on workers that are warm."""
    catalogue = open_catalogue(job.assets, job_folder, tuple(job.categories))
    one, all_of_them, shares = [], [], []

    def make(name: str, slots: int, count: int, shard_size: int) -> tuple[float, float]:
        """(seconds, seconds in shards)."""
        out = folder / name
        LocalStore(out).prepare()
        size, first = job.run.range_size, job.first_scene
        spans = [Span(start=s, stop=s + size) for s in range(first, first + count, size)]
        tally = Tally(asked=count)
        limits = Limits(PREFETCH * slots if slots == workers else slots, 1, count)
        begun = time.perf_counter()
        run_spans((bench_order(job, out), catalogue), group_shards(spans, shard_size), limits, _quiet, tally)
        return time.perf_counter() - begun, tally.shard_wall_s

    with private_ray(workers):
        make("warm", workers, 4 * workers * job.run.range_size, job.run.range_size)
        for number in range(rounds):
            seconds, _ = make(f"one{number}", 1, scenes, shard)
            one.append(seconds)
            seconds, inside = make(f"all{number}", workers, scenes, shard)
            all_of_them.append(seconds)
            shares.append(idle_share(inside, workers, seconds))
    return Scaling(
        workers=workers,
        scenes=scenes,
        shard=shard,
        one_scenes_per_s=scenes / min(one),
        all_scenes_per_s=scenes / min(all_of_them),
        speedup=Spread.of([a / b for a, b in zip(one, all_of_them, strict=True)]),
        ray_share=Spread.of(shares),
    )


_quiet: Callable[[Tally], None] = lambda tally: None  # noqa: E731
