"""The rounds of the benchmark: whole scenes of a job by the production code onto a real disk, beside the other sides."""

import multiprocessing
import tempfile
import time
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from statistics import median
from typing import NamedTuple

from schemas.dataset.commit import Span
from schemas.dataset.shard import ShardOrder
from schemas.errors import OutputError, RunError, SceneError
from schemas.job.job import MOST, Job
from services.bench.figures import Lap, by_processor, describe_machine, pinned, process_age_s
from services.bench.sides import Look, choose_encoders, hand_over, images_of, looks_of, run_lower_bound, start_script
from workers.assets.catalogue import open_catalogue
from workers.geometry.jit import compile_planned
from workers.render.raster.context import require_device
from workers.scene.context import Stopwatch, WorkerContext, open_worker
from workers.scene.make_scene import Scene, make_scene
from workers.shard.run_shard import run_ranges
from workers.store.commit import committed_files, read_record
from workers.store.file_system import sync_tree
from workers.store.local import LocalStore

LOOP_TURNS = 10_000
"""Turns of an empty loop, 0.2 ms, between two looks at the clock."""

WARM_UP = 8
"""Scenes before the clock: they compile shaders, of which pyrender has one for each number of lights, and fill caches."""

ROUND = MOST
"""Scenes of a round where the job does not give its range's: as in a job of 512 scenes or more, whose ranges they are. A
smaller job commits more often."""

SETTLED = 200
"""Scenes after which every cache is full and every shader compiled."""


@dataclass(eq=False)
class Workbench:
    """A worker's context and a dataset's folder, ready to make one range after another."""

    context: WorkerContext
    store: LocalStore
    order: ShardOrder
    next_scene: int

    def next_span(self, scenes: int) -> Span:
        """The next range, of new scenes, so that no shape is cached already."""
        span = Span(start=self.next_scene, stop=self.next_scene + scenes)
        self.next_scene = span.stop
        return span

    def run(self, *spans: Span) -> Lap:
        """Make and commit ranges. Raises RunError where none of their scenes could be made."""
        watch = Stopwatch()
        wall, cpu = time.perf_counter(), time.process_time()
        reports = run_ranges(self.context, self.store, self.order, spans, watch)
        made = sum(report.made for report in reports)
        lap = Lap(made, time.perf_counter() - wall, time.process_time() - cpu, watch.seconds)
        if not made:
            failed = {reason for report in reports for reason in report.failed}
            raise RunError(
                f"none of the scenes {spans[0].start} to {spans[-1].stop - 1} could be made: {', '.join(sorted(failed))}"
            )
        return lap

    def files(self, span: Span) -> dict[str, bytes]:
        """The bytes of every file that the range's commit names, by path."""
        record = read_record(self.store, span.start)
        assert record is not None
        return {
            entry.path: (self.store.root / entry.path).read_bytes() for entry in committed_files(self.store, record)
        }


def open_workbench(job: Job, job_folder: Path, out: Path) -> Workbench:
    """A workbench for the job's scenes in an empty folder."""
    catalogue = open_catalogue(job.assets, job_folder, tuple(job.categories))
    store = LocalStore(out)
    store.prepare()
    compile_planned()
    context = open_worker(job, catalogue)
    require_device(context.renderer.name, job.run.device, context.renderer.choice)
    return Workbench(context, store, ShardOrder.of(str(out), job, "bench"), job.first_scene)


def make_in_memory(context: WorkerContext, span: Span) -> list[Scene]:
    """The scenes that can be made, as input for the other sides. Raises RunError for none."""
    made, reason = [], ""
    for scene_id in span.scene_ids:
        try:
            made.append(make_scene(context, scene_id, Stopwatch()))
        except SceneError as error:
            reason = str(error)
    if not made:
        raise RunError(f"none of the scenes {span.start} to {span.stop - 1} could be made: {reason}")
    return made


def run_process(job: Job, job_folder: Path, folder: Path, span: Span) -> Lap:
    """A plain process's part: make and commit a span into a new folder, range by range."""
    bench = open_workbench(job, job_folder, folder)
    starts = range(span.start, span.stop, job.range_size)
    return bench.run(*(Span(start=start, stop=min(start + job.range_size, span.stop)) for start in starts))


def count_for(seconds: float) -> Lap:
    """So many turns of an empty loop as `scenes`: what the core gives to one that uses no memory and waits for nothing."""
    turns, wall, cpu = 0, time.perf_counter(), time.process_time()
    while time.perf_counter() < wall + seconds:
        for _ in range(LOOP_TURNS):
            pass
        turns += LOOP_TURNS
    return Lap(turns, time.perf_counter() - wall, time.process_time() - cpu, {})


@dataclass(frozen=True)
class Measured:
    """The laps of each side, one a round in which all make the same scenes, and the bytes that ours committed."""

    machine: dict[str, object]
    core: int
    laps: Mapping[str, list[Lap]]
    """By the side's name; `ours` and `floor`, the lower bound, are the first two."""
    bytes: int
    encoders: dict[str, str]
    looks: Mapping[str, Look]
    startup_s: dict[str, float]
    """From the start of each side's process to the end of its first scenes."""


@contextmanager
def bench_folder(parent: Path) -> Iterator[Path]:
    """A temporary folder on the disk that is measured. Raises OutputError where none can be made."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(prefix="bench-", dir=parent, ignore_cleanup_errors=True)
    except OSError as error:
        raise OutputError(f"{parent} cannot be written: {error.strerror or error}; choose another --folder") from error
    with folder as name:
        yield Path(name).resolve()


def measure(job: Job, job_folder: Path, folder: Path, scenes: int) -> Measured:
    """Ranges until `scenes` are made, each by all sides in turn on one core: ours, the lower bound, each look of the script.

    Nothing is deleted in between: for seconds afterwards ext4 searches the deleted entries whenever it makes a file.
    """
    with pinned() as core, ExitStack() as running:
        bench = open_workbench(job, job_folder, folder / "ours")
        warm = bench.next_span(WARM_UP)
        bench.run(warm)
        startup_s = {"ours": process_age_s()}
        encoders = choose_encoders(images_of(bench.files(warm)))
        given = _hand_over(make_in_memory(bench.context, warm), job, folder / "given_warm")
        begun = time.perf_counter()
        script, looks = running.enter_context(start_script()), looks_of(job)
        for word, look in looks.items():
            script.run(given, folder / look.name, word)
            startup_s[look.name] = time.perf_counter() - begun
        laps: dict[str, list[Lap]] = {name: [] for name in ("ours", "floor", *(look.name for look in looks.values()))}
        written = 0
        size = job.run.range_size or ROUND
        for start in range(0, scenes, size):
            span = bench.next_span(min(size, scenes - start))
            # What the other sides wrote: ours would wait for it, because its commits flush the file system.
            sync_tree(folder)
            laps["ours"].append(bench.run(span))
            # The input of the next side is made between the clocks.
            files = bench.files(span)
            written += sum(map(len, files.values()))
            made, out = make_in_memory(bench.context, span), folder / f"lower_bound{span.start}"
            laps["floor"].append(run_lower_bound(bench.context.renderer, made, files, encoders, out))
            given = _hand_over(made, job, folder / f"given{span.start}")
            for word, look in looks.items():
                laps[look.name].append(script.run(given, folder / look.name, word))
    names = {kind: name for kind, (name, _) in encoders.items()}
    return Measured(describe_machine(bench.context.renderer.name), core, laps, written, names, looks, startup_s)


def _hand_over(scenes: Sequence[Scene], job: Job, folder: Path) -> list[Path]:
    """The same scenes as files for the script."""
    return [hand_over(scene, job, folder / str(scene.plan.scene_id)) for scene in scenes]


# ---------------------------------------------------------------------------------------------- one worker over many scenes


class Sample(NamedTuple):
    """One range: its scenes, resident MB after it, and seconds of processor a scene."""

    scenes: int
    mb: float
    cpu_s: float


def measure_memory(job: Job, job_folder: Path, folder: Path, scenes: int) -> dict[str, float]:
    """Make that many scenes in one fresh worker; returns the figures of `memory_figures`."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return memory_figures(*pool.submit(sample_memory, job, job_folder, folder, scenes).result())


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


def memory_figures(samples: list[Sample], peak_mb: float) -> dict[str, float]:
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
        "last_to_first": median(paces[-window:]) / median(paces[:window]),
    }
