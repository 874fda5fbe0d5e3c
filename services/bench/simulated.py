"""What the coordinator adds on many nodes, where scenes only take their time: simulated nodes, sleeping workers.

Each node is a raylet of its own with one slot, all on this machine, so what their processes cost is in the figures too.
"""

import contextlib
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ray.cluster_utils import Cluster

from schemas.dataset.commit import CommitSummary, Span
from schemas.dataset.shard import Fingerprint, ShardOrder, ShardReport, SpanReport
from schemas.job.job import Job
from services.run.coordinator import Coordinator, Limits
from services.run.joining import Pattern, terms_of_driver
from services.run.metrics import Tally
from services.run.progress import event_log
from services.run.range_planner import group_shards
from services.run.ray_cluster import OBJECT_STORE_BYTES, PREFETCH, Slots, connection, kept_private, private_folder
from services.run.worker_entry import WorkerTerms
from workers.assets.catalogue import open_catalogue
from workers.store.ledger import LedgerKeeper, list_commits
from workers.store.local import LocalStore

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
    for count in nodes:
        with simulated_nodes(count):
            drive = _Drive(job, folder, count)
            drive.run("warm", 0.05, FEW)
            for seconds in shard_s:
                few, many = (drive.run(f"{count}-{seconds:g}-{shards}", seconds, shards) for shards in (FEW, MANY))
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


@contextlib.contextmanager
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


class _Drive:
    """Runs of the coordinator over sleeping workers."""

    def __init__(self, job: Job, folder: Path, slots: int) -> None:
        self._job, self._folder, self._slots = job, folder, slots
        self._catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))

    def run(self, name: str, shard_s: float, shards: int) -> tuple[float, float]:
        """Wall time and processor time of this process for that many shards a slot, seconds."""
        scenes = self._slots * shards * SHARD
        store = LocalStore(self._folder / name)
        store.prepare()
        spans = (Span(start=start, stop=start + RANGE) for start in range(0, scenes, RANGE))
        pattern = Pattern(
            ShardOrder.of(str(store.root), self._job, "bench"),
            self._catalogue,
            terms_of_driver(),
            enter=sleeping(shard_s),
        )
        limits, tally = Limits(Slots(self._slots, PREFETCH * self._slots), 1, scenes), Tally(asked=scenes)
        with contextlib.closing(LedgerKeeper(store, list_commits(store))) as keeper, event_log(store.root):
            begun, cpu = time.perf_counter(), time.process_time()
            Coordinator(store, pattern, limits, tally).run(
                group_shards(spans, SHARD), lambda now: keeper.add(now.take_commits())
            )
            wall_s, cpu_s = time.perf_counter() - begun, time.process_time() - cpu
        assert tally.made == scenes
        return wall_s, cpu_s


def sleeping(seconds: float) -> Callable[[WorkerTerms, bytes, bytes], ShardReport]:
    """What a worker does for a shard: it waits, and reports the commits that it would have made."""

    def sleep_shard(terms: WorkerTerms, order: bytes, catalogue: bytes) -> ShardReport:
        time.sleep(seconds)
        reports = tuple(
            SpanReport(
                start=span.start,
                stop=span.stop,
                retry=0,
                won=True,
                conflict=None,
                made=span.count,
                failed={},
                commit=CommitSummary(span.start, span.stop, 0, span.count, (), (), "f" * 64, "j" * 64),
            )
            for span in pickle.loads(order).spans
        )
        return ShardReport(
            spans=reports, seconds={"physics": seconds}, wall_s=seconds, cpu_s=0.0, fingerprint=NOBODY, host="h", pid=1
        )

    return sleep_shard


def describe(figures: dict[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    lines = [
        f"coordinator on simulated nodes of one slot, shards of {SHARD} sleeping scenes",
        "",
    ]
    lines.append(
        f"{'nodes':>5}  {'shard':>7}  {'overhead':>8}  {'start':>7}  {'shards/s':>8}  {'of the coordinator':>20}"
    )
    for lap in figures["simulated"]:
        lines.append(
            f"{lap['nodes']:5}  {lap['shard_s']:5.1f} s  {lap['overhead']:8.1%}  {lap['start_s']:5.2f} s  "
            f"{lap['shards_per_s']:8.1f}  "
            f"{lap['coordinator_ms']:13.2f} ms/shard"
        )
    return lines
