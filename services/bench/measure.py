"""The rounds of the benchmark: ours, the lower bound, the script and other systems, in turn, on one core."""

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from schemas.errors import MachineError, OutputError
from schemas.job.job import MOST, Job
from services.bench.handover import hand_over
from services.bench.lower_bound import choose_encoders, images_of, run_lower_bound
from services.bench.machine import describe_machine, pinned, process_age_s
from services.bench.others import Side, SideProcess, sides_of, start_side
from services.bench.ratios import Lap
from services.bench.stages import make_in_memory, open_workbench
from workers.scene.make_scene import Scene
from workers.store.file_system import sync_tree

WARM_UP = 8
"""Scenes before the clock: they compile shaders, of which pyrender has one for each number of lights, and fill caches."""

ROUND = MOST
"""Scenes of a round where the job does not give its range's: as in a job of 512 scenes or more, whose ranges they are. A
smaller job commits more often."""


@dataclass
class Others:
    """The sides that could be started, their processes by module, and the time that each took to its first scenes' end."""

    sides: list[Side] = field(default_factory=list)
    processes: dict[str, SideProcess] = field(default_factory=dict)
    startup_s: dict[str, float] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    """Optional sides that are installed but could not run, and why."""


@dataclass(frozen=True)
class Measured:
    """The laps of each side, one a round in which all make the same scenes, and the bytes that ours committed."""

    machine: dict[str, object]
    core: int
    laps: Mapping[str, list[Lap]]
    """By the side's name; `ours` and `floor`, the lower bound, are the first two."""
    bytes: int
    encoders: dict[str, str]
    others: Others


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
    """Ranges until `scenes` are made, each by all sides in turn.

    Nothing is deleted in between: for seconds afterwards ext4 searches the deleted entries whenever it makes a file.
    """
    with pinned() as core, ExitStack() as running:
        bench = open_workbench(job, job_folder, folder / "ours")
        warm = bench.next_span(WARM_UP)
        bench.run(warm)
        startup_s = {"ours": process_age_s()}
        encoders = choose_encoders(images_of(bench.files(warm)))
        given = _hand_over(make_in_memory(bench.context, warm), job, folder / "given_warm")
        others = start_others(sides_of(job), given, folder, running)
        laps: dict[str, list[Lap]] = {name: [] for name in ("ours", "floor", *(side.name for side in others.sides))}
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
            for side in others.sides:
                laps[side.name].append(others.processes[side.module].run(given, folder / side.name, side.asked))
    others.startup_s = startup_s | others.startup_s
    names = {kind: name for kind, (name, _) in encoders.items()}
    return Measured(describe_machine(bench.context.renderer.name), core, laps, written, names, others)


def start_others(sides: Sequence[Side], given: list[Path], folder: Path, running: ExitStack) -> Others:
    """Start the other systems and let each make these scenes.

    Raises MachineError where the script cannot run; an optional side that cannot is left out with the reason.
    """
    others = Others()
    for side in sides:
        begun = time.perf_counter()
        try:
            if side.module not in others.processes:
                others.processes[side.module] = running.enter_context(start_side(side.module))
            others.processes[side.module].run(given, folder / side.name, side.asked)
            others.sides.append(side)
        except MachineError as error:
            if side.package is None:
                raise
            others.left_out[side.title] = str(error)
        others.startup_s[side.name] = time.perf_counter() - begun
    return others


def _hand_over(scenes: Sequence[Scene], job: Job, folder: Path) -> list[Path]:
    """The same scenes as files for the other sides."""
    return [hand_over(scene, job, folder / str(scene.plan.scene_id)) for scene in scenes]
