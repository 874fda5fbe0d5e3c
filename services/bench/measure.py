"""The rounds of the benchmark: whole scenes of a job by the production code onto a real disk, beside the other sides.

The lower bound of time for the same files is bare draws, the same encoding, and the same durable write.
"""

import os
import pickle
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from schemas.dataset.commit import Span
from schemas.dataset.shard import ShardOrder
from schemas.errors import OutputError, RunError, SceneError
from schemas.job.job import MOST, Job
from services.bench.figures import Lap, describe_machine, pinned
from services.bench.script import LOOKS, hand_over, start_script
from workers.capture.results import open_sources
from workers.geometry.jit import compile_planned
from workers.render.raster.context import require_device
from workers.render.raster.gbuffer import FLAT, Renderer
from workers.scene.context import WorkerContext, open_worker
from workers.scene.make_scene import Scene, make_scene
from workers.shard.run_shard import run_ranges
from workers.stopwatch import Stopwatch
from workers.store.commit import committed_files, read_record
from workers.store.file_system import OpenTree
from workers.store.images import decode_png, encode_png
from workers.store.local import LocalStore

WARM_UP = 8
"""Scenes before the clock: they compile shaders, of which pyrender has one for each number of lights, and fill caches."""

ROUND = MOST
"""Scenes of a round where the job does not give its range's: as in a job of 512 scenes or more, whose ranges they are. A
smaller job commits more often."""


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
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        made = sum(report.made for report in reports)
        if not made:
            why = ", ".join(sorted({reason for report in reports for reason in report.failed}))
            raise RunError(f"none of the scenes {spans[0].start} to {spans[-1].stop - 1} could be made: {why}")
        return Lap(made, wall, cpu, watch.seconds)

    def files(self, span: Span) -> dict[str, bytes]:
        """The bytes of every file that the range's commit names, by path."""
        record = read_record(self.store, span.start)
        assert record is not None
        return {
            entry.path: (self.store.root / entry.path).read_bytes() for entry in committed_files(self.store, record)
        }


def open_workbench(job: Job, job_folder: Path, out: Path) -> Workbench:
    """A workbench for the job's scenes in an empty folder."""
    catalogue = open_sources(job, job_folder)
    store = LocalStore(out)
    store.prepare()
    compile_planned()
    context = open_worker(job, catalogue)
    require_device(context.renderer.name, job.run.device, context.renderer.choice)
    return Workbench(context, store, ShardOrder.of(str(out), job, "bench"), job.first_scene)


def make_in_memory(context: WorkerContext, span: Span) -> list[Scene]:
    """The scenes that can be made, as input for the other sides."""
    made = []
    for scene_id in span.scene_ids:
        with suppress(SceneError):
            made.append(make_scene(context, scene_id, Stopwatch()))
    return made


class Part(NamedTuple):
    """What a plain process makes, into a new folder, on which core."""

    job: Job
    job_folder: Path
    out: Path
    span: Span
    core: int


def run_part(part: Part) -> bytes:
    """In a plain process: the pickled lap of making and committing a span, range by range."""
    os.sched_setaffinity(0, {part.core})
    bench = open_workbench(part.job, part.job_folder, part.out)
    starts = range(part.span.start, part.span.stop, part.job.range_size)
    ranges = [Span(start=start, stop=min(start + part.job.range_size, part.span.stop)) for start in starts]
    return pickle.dumps(bench.run(*ranges))


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


class Measured(NamedTuple):
    """The laps of each side, one a round in which all make the same scenes, and the bytes that ours committed."""

    machine: Mapping[str, object]
    core: int
    bytes: int
    ours: list[Lap]
    floor: list[Lap]
    """Of the lower bound."""
    script: Mapping[str, list[Lap]]
    """By look."""


def measure(job: Job, job_folder: Path, folder: Path, scenes: int) -> Measured:
    """Ranges until `scenes` are made, each by all sides in turn on one core: ours, the lower bound, each look of the script.

    Nothing is deleted in between: for seconds afterwards ext4 searches the deleted entries whenever it makes a file.
    """
    # The flat tier has no shadows, and a path tracer is no rival of pyrender.
    looks = LOOKS if job.render.tier == "raster" and job.scene == "tabletop" else ["plain"]
    laps: dict[str, list[Lap]] = {look: [] for look in looks}
    ours: list[Lap] = []
    floor: list[Lap] = []
    written, size = 0, job.run.range_size or ROUND
    with pinned() as core, start_script() as script:
        bench = open_workbench(job, job_folder, folder / "ours")
        warm = bench.next_span(WARM_UP)
        bench.run(warm)
        given = [hand_over(scene, job, folder / "given") for scene in make_in_memory(bench.context, warm)]
        for look in laps:
            script.run(given, folder / look, look)
        for start in range(0, scenes, size):
            span = bench.next_span(min(size, scenes - start))
            # What the other sides wrote: ours would wait for it, because its commits flush the file system.
            os.sync()
            ours.append(bench.run(span))
            # The input of the next side is made between the clocks.
            files, made = bench.files(span), make_in_memory(bench.context, span)
            written += sum(map(len, files.values()))
            floor.append(run_lower_bound(bench.context.renderer, made, files, folder / f"lower_bound{span.start}"))
            given = [hand_over(scene, job, folder / "given") for scene in made]
            for look, of_look in laps.items():
                of_look.append(script.run(given, folder / look, look))
    return Measured(describe_machine(bench.context.renderer.name), core, written, ours, floor, laps)


# ---------------------------------------------------------------------------------------------- the lower bound


def run_lower_bound(renderer: Renderer, scenes: Sequence[Scene], files: Mapping[str, bytes], folder: Path) -> Lap:
    """Draw every view, encode every image, and write every byte so that it survives a loss of power. `folder` is new.

    The lap's `apart_s` is a first draw of each scene, which uploads its shapes.
    """
    upload, draw, draw_cpu = _draw(renderer, scenes)
    images = [decode_png(data, path) for path, data in files.items() if path.endswith(".png")]
    begun, cpu = time.perf_counter(), time.process_time()
    for pixels in images:
        encode_png(pixels)
    encoded = time.perf_counter()
    folder.mkdir(parents=True)
    tree = OpenTree(folder)
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        with open(folder / path, "wb") as file:
            file.write(data)
            tree.flush_file(file)
    tree.flush(folder.parent)
    written = time.perf_counter()
    stages = {"draw": draw, "encode": encoded - begun, "write": written - encoded}
    return Lap(len(scenes), sum(stages.values()), draw_cpu + time.process_time() - cpu, stages, upload)


def _draw(renderer: Renderer, scenes: Sequence[Scene]) -> tuple[float, float, float]:
    """Seconds of uploading every scene's shapes, then of the clock and of the processor for bare passes.

    A bare pass draws and reads back colour without shadows, depth and region, as tier flat does, whatever the job's tier.
    """
    upload, wall, cpu = 0.0, 0.0, 0.0
    for scene in scenes:
        cameras = [view.camera for _, view in scene.views() if view.role != "projected"]
        things, appearance = scene.posed.things, scene.posed.appearance
        begun = time.perf_counter()
        renderer.draw(things, appearance, cameras[0], FLAT)
        uploaded, uploaded_cpu = time.perf_counter(), time.process_time()
        for camera in cameras:
            renderer.draw(things, appearance, camera, FLAT)
        upload, wall = upload + uploaded - begun, wall + time.perf_counter() - uploaded
        cpu += time.process_time() - uploaded_cpu
    return upload, wall, cpu
