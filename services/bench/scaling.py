"""Several workers against one, and what the coordinator adds on many nodes. Loads Ray.

Two processes that share nothing but the machine seldom do twice the work of one: cores share caches, memory and clock,
and are often two threads of one core. No scheduler can gain more than plain processes do, and these no more than empty
loops, which use nothing but cores: two virtual cores may be worth less than two of the first.

A simulated node is a raylet of its own with one slot, all on this machine, so what their processes cost is in the figures
too; scenes only take their time there.
"""

import multiprocessing
import os
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from ray.cluster_utils import Cluster

from schemas.dataset.commit import CommitSummary, Span
from schemas.dataset.shard import Fingerprint, ShardOrder, ShardReport, SpanReport
from schemas.errors import RunError
from schemas.job.job import Job
from services.bench.figures import Lap, Spread, by_clock, by_processor, slope_ratio
from services.bench.measure import WARM_UP, count_for, run_process
from services.run.coordinator import Coordinator, Limits
from services.run.joining import EnterShard, Pattern, terms_of_driver
from services.run.metrics import Tally
from services.run.progress import event_log
from services.run.range_planner import deal_shards, group_shards, plan_ranges
from services.run.ray_cluster import (
    OBJECT_STORE_BYTES,
    PREFETCH,
    Slots,
    connection,
    kept_private,
    private_folder,
    private_ray,
)
from services.run.worker_entry import WorkerTerms, enter_shard
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.store.ledger import LedgerKeeper, list_commits
from workers.store.local import LocalStore

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
    drive = _Drive(job, folder, open_catalogue(job.assets, job_folder, tuple(job.categories)))
    with private_ray(workers), plain_processes(job, job_folder, folder, workers) as processes:
        drive.run_scenes("warm", Slots(workers, PREFETCH * workers), 4 * workers * job.range_size)
        for number in range(rounds):
            for count in counts:
                # The other slot could start a waiting shard, so one worker gets one shard at a time.
                in_flight = PREFETCH * count if count == workers else count
                ray[count].append(drive.run_scenes(f"{number}-{count}", Slots(count, in_flight), scenes))
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
        "one_scenes_per_s": median(1.0 / by_clock(lap) for lap in one),
        "all_scenes_per_s": median(1.0 / by_clock(lap) for lap in several),
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
class _Drive:
    """Runs of the coordinator on a running Ray, each into a new folder."""

    job: Job
    folder: Path
    catalogue: Catalogue

    def run_scenes(self, name: str, slots: Slots, count: int) -> tuple[Lap, float]:
        """A lap of that many scenes, and the share of the slots' time without a shard: handed out, or its uneven end."""
        size, first = self.job.range_size, self.job.first_scene
        spans = (Span(start=start, stop=stop) for start, stop in plan_ranges(first, first + count, size, []))
        shards = deal_shards(spans, count, size, lambda: slots.running)
        tally, wall_s, _ = self._coordinate(self._store(name), slots, count, shards)
        return Lap(tally.made, wall_s, tally.shard_cpu_s, {}), 1.0 - tally.shard_wall_s / (slots.running * wall_s)

    def run_sleeping(self, name: str, nodes: int, shard_s: float, shards: int) -> tuple[float, float]:
        """Wall time and processor time of this process for that many sleeping shards a node, seconds."""
        count, store = nodes * shards * SHARD, self._store(name)
        spans = (Span(start=start, stop=start + RANGE) for start in range(0, count, RANGE))
        with closing(LedgerKeeper(store, list_commits(store))) as keeper, event_log(store.root):
            tally, *times = self._coordinate(
                store,
                Slots(nodes, PREFETCH * nodes),
                count,
                group_shards(spans, SHARD),
                sleeping(shard_s),
                lambda now: keeper.add(now.take_commits()),
            )
        assert tally.made == count
        return times[0], times[1]

    def _store(self, name: str) -> LocalStore:
        store = LocalStore(self.folder / name)
        store.prepare()
        return store

    def _coordinate(
        self,
        store: LocalStore,
        slots: Slots,
        count: int,
        shards: Iterator[tuple[Span, ...]],
        enter: EnterShard = enter_shard,
        progress: Callable[[Tally], None] = lambda tally: None,
    ) -> tuple[Tally, float, float]:
        """The tally of a run, and its wall time and this process's processor time, seconds."""
        tally, order = Tally(asked=count), ShardOrder.of(str(store.root), self.job, "bench")
        pattern = Pattern(order, self.catalogue, terms_of_driver(), enter=enter)
        begun, cpu = time.perf_counter(), time.process_time()
        Coordinator(store, pattern, Limits(slots, 1, count), tally).run(shards, progress)
        return tally, time.perf_counter() - begun, time.process_time() - cpu


# ---------------------------------------------------------------------------------------------- simulated nodes

SHARD, RANGE = 64, 16
"""Scenes in a shard and in a range, as a large job has them."""

FEW, MANY = 2, 12
"""Shards a slot of the two runs whose difference is a measurement: how a run begins and ends is in both."""

SHARD_S = (2.0, 0.5, 0.1)
"""Time of a shard. 64 scenes of the default tier take 8 s: these have as many reports as 4, 16 and 80 times the nodes."""

NOBODY = Fingerprint(canary="", code="", libraries={}, simd="", renderer="")


def measure_simulated(job: Job, folder: Path, nodes: Sequence[int], shard_s: Sequence[float]) -> list[dict[str, Any]]:
    """The overhead by number of nodes and time of a shard: wall time over what the sleeps alone take, less one.

    From the difference of a short and a long run; `start_s` is what a run takes beside. `shards_per_s` that end;
    `coordinator_ms`: processor time of the coordinator's process a shard, of which the largest number of shards a second
    follows. Raises MachineError where Ray does not start.
    """
    found = []
    drive = _Drive(job, folder, open_catalogue(job.assets, Path(), tuple(job.categories)))
    for count in nodes:
        with simulated_nodes(count):
            drive.run_sleeping("warm", count, 0.05, FEW)
            for seconds in shard_s:
                few, many = (
                    drive.run_sleeping(f"{count}-{seconds:g}-{shards}", count, seconds, shards)
                    for shards in (FEW, MANY)
                )
                found.append({"nodes": count, "shard_s": seconds, **compare(few, many, count, seconds)})
    return found


def compare(few: tuple[float, float], many: tuple[float, float], slots: int, shard_s: float) -> dict[str, float]:
    """The figures, from wall time and processor time of the run with `FEW` shards a slot and of that with `MANY`."""
    wall_s, cpu_s = many[0] - few[0], many[1] - few[1]
    shards = slots * (MANY - FEW)
    return {
        "overhead": wall_s / ((MANY - FEW) * shard_s) - 1.0,
        "start_s": few[0] - FEW * wall_s / (MANY - FEW),
        "shards_per_s": shards / wall_s,
        "coordinator_ms": 1e3 * cpu_s / shards,
    }


@contextmanager
def simulated_nodes(count: int) -> Iterator[None]:
    """A Ray of that many nodes on loopback, each with one slot, and a head without any; ended with the block."""
    with private_folder() as folder, kept_private():
        settings = {
            "object_store_memory": OBJECT_STORE_BYTES,
            "node_ip_address": "127.0.0.1",
            "include_dashboard": False,
        }
        head = {**settings, "num_cpus": 0, "temp_dir": str(folder)}
        cluster = Cluster(initialize_head=True, head_node_args=head)
        try:
            for _ in range(count):
                cluster.add_node(wait=False, num_cpus=1, **settings)
            cluster.wait_for_nodes(timeout=30.0 + 10.0 * count)
            with connection(cluster.address):
                yield
        finally:
            cluster.shutdown()


def sleeping(seconds: float) -> Callable[[WorkerTerms, bytes, bytes], ShardReport]:
    """What a worker does for a shard: it waits, and reports the commits that it would have made."""

    def sleep_shard(terms: WorkerTerms, order: bytes, catalogue: bytes) -> ShardReport:
        time.sleep(seconds)
        reports = tuple(map(reported, pickle.loads(order).spans))
        times: dict[str, Any] = {"seconds": {"physics": seconds}, "wall_s": seconds, "cpu_s": 0.0}
        return ShardReport(spans=reports, **times, fingerprint=NOBODY, host="h", pid=1)

    def reported(span: Span) -> SpanReport:
        commit = CommitSummary(span.start, span.stop, 0, span.count, (), (), "f" * 64, "j" * 64)
        ends: dict[str, Any] = {"start": span.start, "stop": span.stop, "retry": 0, "won": True, "conflict": None}
        return SpanReport(**ends, made=span.count, failed={}, commit=commit)

    return sleep_shard


def describe(figures: dict[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    columns = f"{'nodes':>5}  {'shard':>7}  {'overhead':>8}  {'start':>7}  {'shards/s':>8}  {'of the coordinator':>20}"
    return [
        f"coordinator on simulated nodes of one slot, shards of {SHARD} sleeping scenes",
        "",
        columns,
        *(
            f"{lap['nodes']:5}  {lap['shard_s']:5.1f} s  {lap['overhead']:8.1%}  {lap['start_s']:5.2f} s  "
            f"{lap['shards_per_s']:8.1f}  {lap['coordinator_ms']:13.2f} ms/shard"
            for lap in figures["simulated"]
        ),
    ]
