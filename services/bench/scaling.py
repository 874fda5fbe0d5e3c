"""Several workers against one, through Ray and without it. Loads Ray.

Two processes that share nothing but the machine seldom do twice the work of one: cores share caches, memory and clock,
and are often two threads of one core. No scheduler can gain more than plain processes do.
"""

import os
import pickle
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from schemas.dataset.commit import Span
from schemas.dataset.shard import ShardOrder
from schemas.errors import RunError
from schemas.job.job import Job
from services.bench.figures import Lap, by_clock, by_processor, slope_ratio, spread_of
from services.bench.measure import WARM_UP, Part, run_part
from services.run.coordinator import Coordinator, Limits
from services.run.progress import Tally
from services.run.range_planner import deal_shards, plan_ranges
from services.run.ray_cluster import PREFETCH, Slots, private_ray
from services.run.worker_entry import Pattern, terms_of_driver
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.pool import Ended, Pool
from workers.store.local import LocalStore


def measure_scaling(
    job: Job, job_folder: Path, folder: Path, workers: int, scenes: int, rounds: int = 3
) -> dict[str, Any]:
    """One worker, all workers, one process, all processes, and again; always the same scenes, into new folders.

    Ranges and shards are those of a run of that many scenes. Everything is warm before: Ray's start, imports, the OpenGL
    context and its shaders are in no figure. `ray`: workers through the coordinator; `bare`: plain processes, each on a core
    of its own. ray_share: the share of the slots' time without a shard, the uneven end of the last shards included;
    ray_share_one: the same with one worker, which has no such end. share_of_bare: Ray's speed-up over that of plain processes.
    """
    job = job.model_copy(update={"scenes": scenes})
    counts = (1, workers)
    ray: dict[int, list[tuple[Lap, float]]] = {count: [] for count in counts}
    bare: dict[int, list[Lap]] = {count: [] for count in counts}
    catalogue = open_catalogue(job.assets, job_folder, tuple(job.categories))
    with private_ray(workers), Pool(run_part, processes=workers, quiet=False) as pool:
        runs = _Runs(job, job_folder, folder, catalogue, pool)
        runs.plain("warm", workers, WARM_UP)
        runs.through_ray("warm", Slots(workers, PREFETCH * workers), 4 * workers * job.range_size)
        for number in range(rounds):
            for count in counts:
                # The other slot could start a waiting shard, so one worker gets one shard at a time.
                in_flight = PREFETCH * count if count == workers else count
                ray[count].append(runs.through_ray(f"{number}-{count}", Slots(count, in_flight), scenes))
            for count in counts:
                bare[count].append(runs.plain(f"{number}-{count}", count, max(1, scenes // workers)))
    gain = gain_of(*([lap for lap, _ in ray[count]] for count in counts))
    reference = gain_of(bare[1], bare[workers])
    return {
        "workers": workers,
        "range": job.range_size,
        "ray": gain,
        "bare": reference,
        "ray_share": spread_of([idle for _, idle in ray[workers]]),
        "ray_share_one": spread_of([idle for _, idle in ray[1]]),
        "share_of_bare": gain["speedup"]["median"] / reference["speedup"]["median"],
    }


def gain_of(one: Sequence[Lap], several: Sequence[Lap]) -> dict[str, Any]:
    """The gain of several at once over one, from laps in pairs; a lap lasts from the first start to the last end.

    speedup: ratio of the paces; inflation: ratio of the processor time a scene, the cost of sharing caches, memory and clock,
    without waiting.
    """
    return {
        "scenes": several[0].scenes,
        "one_scenes_per_s": median(1.0 / by_clock(lap) for lap in one),
        "all_scenes_per_s": median(1.0 / by_clock(lap) for lap in several),
        "speedup": slope_ratio(one, several),
        "inflation": slope_ratio(several, one, by_processor),
    }


@dataclass(frozen=True)
class _Runs:
    """Runs on a running Ray and in warm plain processes, each into a new folder."""

    job: Job
    job_folder: Path
    folder: Path
    catalogue: Catalogue
    pool: Pool[Part]

    def through_ray(self, name: str, slots: Slots, count: int) -> tuple[Lap, float]:
        """A lap of that many scenes, and the share of the slots' time without a shard: handed out, or its uneven end."""
        store = LocalStore(self.folder / name)
        store.prepare()
        size, first = self.job.range_size, self.job.first_scene
        spans = (Span(start=start, stop=stop) for start, stop in plan_ranges(first, first + count, size, []))
        shards = deal_shards(spans, count, size, lambda: slots.running)
        pattern = Pattern(ShardOrder.of(str(store.root), self.job, "bench"), self.catalogue, terms_of_driver())
        tally, begun = Tally(asked=count), time.perf_counter()
        Coordinator(store, pattern, Limits(slots, 1, count), tally).run(shards)
        wall_s = time.perf_counter() - begun
        return Lap(tally.made, wall_s, tally.shard_cpu_s, {}), 1.0 - tally.shard_wall_s / (slots.running * wall_s)

    def plain(self, name: str, count: int, scenes: int) -> Lap:
        """`count` processes, each on a core of its own, make the same first scenes at the same time, until the last one ends."""
        cores, first, laps = sorted(os.sched_getaffinity(0)), self.job.first_scene, []
        span = Span(start=first, stop=first + scenes)
        outs = [self.folder / f"bare{number}" / name for number in range(count)]
        parts = [Part(self.job, self.job_folder, out, span, cores[n % len(cores)]) for n, out in enumerate(outs)]
        for _, answer in self.pool.run(parts):
            if isinstance(answer, Ended):
                raise RunError(f"a plain process of the benchmark {answer.detail}; its last words stand above")
            laps.append(pickle.loads(answer))
        return Lap(sum(lap.scenes for lap in laps), max(lap.wall_s for lap in laps), sum(lap.cpu_s for lap in laps), {})
