"""The rounds of the benchmark: ours, the lower bound, the script and other systems, in turn, on one core."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from schemas.dataset.commit import Span
from schemas.errors import MachineError, OutputError
from schemas.job.job import Job
from services.bench.encoders import Encoder, choose_encoders
from services.bench.handover import hand_over
from services.bench.lower_bound import committed_files, images_of, run_lower_bound
from services.bench.machine import describe_machine, pinned, process_age_s
from services.bench.others import Side, sides_of
from services.bench.ratios import Lap
from services.bench.side_process import SideProcess, side_process
from services.bench.stages import Workbench, open_workbench

WARM_UP = 8
"""Scenes before the clock: they compile shaders, of which pyrender has one for each number of lights, and fill caches."""


@dataclass(frozen=True)
class Round:
    """The same scenes made by each side, one after the other, and the bytes that our side committed."""

    ours: Lap
    lower_bound: Lap
    others: Mapping[str, Lap]
    """By name of the side."""
    bytes: int


@dataclass(frozen=True)
class Measured:
    """All rounds, and by side the seconds from the start of its process to the end of its first scenes."""

    machine: dict[str, object]
    core: int
    rounds: tuple[Round, ...]
    encoders: dict[str, str]
    sides: tuple[Side, ...]
    startup_s: Mapping[str, float]
    left_out: Mapping[str, str]
    """Optional sides that are installed but could not run, and why."""


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
    """Ranges of the job's size until `scenes` are made, each by all sides in turn.

    Nothing is deleted in between: for seconds afterwards ext4 searches the deleted entries whenever it makes a file.
    """
    with pinned() as core, ExitStack() as processes:
        bench = open_workbench(job, job_folder, folder / "ours")
        warm = bench.next_span(WARM_UP)
        bench.run(warm)
        startup_s = {"ours": process_age_s()}
        encoders = choose_encoders(images_of(committed_files(bench.store.root, bench.record(warm))))
        sides = _Sides(bench, encoders, folder, processes)
        given = sides.give(warm)
        for side in sides_of(job):
            startup_s[side.name] = sides.open(side, given)
        rounds = tuple(sides.round(bench.next_span(count)) for count in _counts(scenes, job.run.range_size))
    return Measured(
        describe_machine(bench.context.renderer.name),
        core,
        rounds,
        {kind: name for kind, (name, _) in encoders.items()},
        tuple(sides.opened),
        startup_s,
        sides.left_out,
    )


@dataclass(frozen=True, eq=False)
class _Sides:
    """Everything that is compared, and the processes of the other sides: one for each module."""

    bench: Workbench
    encoders: dict[str, tuple[str, Encoder]]
    folder: Path
    running: ExitStack
    processes: dict[str, SideProcess] = field(default_factory=dict)
    opened: list[Side] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)

    def open(self, side: Side, given: list[Path]) -> float:
        """Start a side and let it make these scenes; returns the seconds that took.

        Raises MachineError where the script cannot run; an optional side that cannot is left out with the reason.
        """
        took = 0.0
        try:
            if side.module not in self.processes:
                self.processes[side.module], took = self.running.enter_context(side_process(side.module))
            lap = self.processes[side.module].run(given, self.folder / side.name, side.asked)
        except MachineError as error:
            if side.package is None:
                raise
            self.left_out[side.title] = str(error)
            return took
        self.opened.append(side)
        return took + lap.wall_s + lap.apart_s

    def round(self, span: Span) -> Round:
        """Ours, the lower bound, the others. The input of the next side is made between their clocks."""
        ours = self.bench.run(span)
        files = committed_files(self.bench.store.root, self.bench.record(span))
        out = self.folder / f"lower_bound{span.start}"
        bound = run_lower_bound(self.bench.context.renderer, self.bench.scenes(span), files, self.encoders, out)
        given = self.give(span)
        others = {
            side.name: self.processes[side.module].run(given, self.folder / side.name, side.asked)
            for side in self.opened
        }
        return Round(ours, bound, others, sum(map(len, files.values())))

    def give(self, span: Span) -> list[Path]:
        """The same scenes as files for the other sides."""
        folder, job = self.folder / f"given{span.start}", self.bench.context.job
        return [hand_over(scene, job, folder / str(scene.plan.scene_id)) for scene in self.bench.scenes(span)]


def _counts(scenes: int, size: int) -> list[int]:
    """Scenes of each round: whole ranges, and what is left."""
    return [min(size, scenes - start) for start in range(0, scenes, size)]
