"""The benchmark's rounds: ours, the floor and the straightforward script, in turn, on one core."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from schemas.commit import Span
from schemas.errors import OutputError
from schemas.job import Job
from services.bench.floor import Encoder, choose_encoders, clear, committed_files, images_of, run_floor
from services.bench.handover import hand_over
from services.bench.machine import describe_machine, pinned, process_age_s
from services.bench.ratios import Lap
from services.bench.script_process import ScriptProcess, script_process
from services.bench.stages import Workbench, open_workbench

WARM_UP = 2
"""Scenes before the clock: shaders are made and caches filled."""


@dataclass(frozen=True)
class Round:
    """The same scenes made by each side, one after the other, and the bytes that ours committed."""

    ours: Lap
    floor: Lap
    script: Lap
    bytes: int


@dataclass(frozen=True)
class Measured:
    """All rounds, and seconds from the start of each process to the end of its first scenes."""

    machine: dict[str, object]
    core: int
    rounds: tuple[Round, ...]
    encoders: dict[str, str]
    startup_ours_s: float
    startup_script_s: float


@contextmanager
def bench_folder(parent: Path) -> Iterator[Path]:
    """A folder on the disk that is measured, gone afterwards. Raises OutputError where none can be made."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(prefix="bench-", dir=parent, ignore_cleanup_errors=True)
    except OSError as error:
        raise OutputError(f"{parent} cannot be written: {error.strerror or error}; choose another --folder") from error
    with folder as name:
        yield Path(name).resolve()


def measure(job: Job, job_folder: Path, folder: Path, scenes: int) -> Measured:
    """Ranges of the job's size until `scenes` are made, each by all sides in turn."""
    with pinned() as core:
        bench = open_workbench(job, job_folder, folder / "ours")
        warm = bench.next_span(WARM_UP)
        bench.run(warm)
        startup_ours_s = process_age_s()
        encoders = choose_encoders(images_of(committed_files(bench.store.root, bench.record(warm))))
        with script_process() as (script, startup_script_s):
            sides = _Sides(bench, script, encoders, folder)
            startup_script_s += sides.script(warm).wall_s
            rounds = tuple(sides.round(bench.next_span(count)) for count in _counts(scenes, job.run.range_size))
    machine = describe_machine(bench.context.renderer.name)
    names = {kind: name for kind, (name, _) in encoders.items()}
    return Measured(machine, core, rounds, names, startup_ours_s, startup_script_s)


@dataclass(frozen=True, eq=False)
class _Sides:
    """Everything that is compared."""

    bench: Workbench
    process: ScriptProcess
    encoders: dict[str, tuple[str, Encoder]]
    folder: Path

    def round(self, span: Span) -> Round:
        """Ours, the floor, the script: what one hands to the next is made between their clocks."""
        ours = self.bench.run(span)
        files = committed_files(self.bench.store.root, self.bench.record(span))
        floor = self.floor(span, files)
        return Round(ours, floor, self.script(span), sum(map(len, files.values())))

    def floor(self, span: Span, files: dict[str, bytes]) -> Lap:
        """The least for the scenes of a span."""
        out = self.folder / f"floor{span.start}"
        lap = run_floor(self.bench.context.renderer, self.bench.scenes(span), files, self.encoders, out)
        clear(out)
        return lap

    def script(self, span: Span) -> Lap:
        """The same scenes by the script."""
        given, out = self.folder / f"given{span.start}", self.folder / "script"
        scenes = [
            hand_over(scene, self.bench.context.job, given / str(scene.plan.scene_id))
            for scene in self.bench.scenes(span)
        ]
        lap = self.process.run(scenes, out)
        clear(given)
        return lap


def _counts(scenes: int, size: int) -> list[int]:
    """Scenes of each round: whole ranges, and what is left."""
    return [min(size, scenes - start) for start in range(0, scenes, size)]
