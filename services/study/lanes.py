"""Processes that measure side by side, one that dies takes nothing along; and the journal that keeps their answers.

With the journal, a file of answers, the same command goes on where it stopped.
"""

import json
import math
import multiprocessing
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from schemas.errors import OutputError
from schemas.job.job import Job
from services.study.knobs import apply
from services.study.model import OWN, Setting
from workers.assets.catalogue import open_catalogue
from workers.scene.context import WorkerContext, open_worker

DIED = "the process that measured it died"


@dataclass(frozen=True)
class Unit:
    """One scene to measure with these settings on top of a base setting.

    `number` is its place among the measured scenes; `part` one of services/study/table.py.
    """

    part: str
    scene_id: int
    number: int
    settings: tuple[Setting, ...]
    base: Setting = OWN
    limit_s: float = math.inf
    """Seconds of processor that one setting may take."""


class Lanes:
    """Within `with`, as many processes as asked for; `scratch` is a folder that they share."""

    def __init__(self, job: Job, job_folder: Path, count: int, scratch: Path) -> None:
        """Starts none yet."""
        self._told = job.model_dump_json(), str(job_folder), str(scratch)
        self._count = count
        self._lanes: list[_Lane] = []

    def __enter__(self) -> "Lanes":
        return self

    def __exit__(self, *_: object) -> None:
        for lane in self._lanes:
            lane.end()

    def run(
        self, units: Sequence[Unit], deadline: float, latest: float | None = None
    ) -> Iterator[tuple[Unit, Mapping[str, Any]]]:
        """Answers by the settings' names of each unit that is done in time, by the monotonic clock, as they come.

        Units are begun in their order until the deadline. Those that are under way `latest` are ended, and have no answers.
        """
        latest = deadline if latest is None else latest
        waiting = list(reversed(units))
        while True:
            for place, lane in enumerate(self._lanes):
                if not lane.process.is_alive() and lane.unit is None:
                    self._lanes[place] = _Lane(*self._told)
            while len(self._lanes) < min(self._count, len(units)):
                self._lanes.append(_Lane(*self._told))
            left_s = deadline - time.monotonic()
            for lane in self._lanes:
                if lane.unit is None and waiting and left_s > 0.0:
                    lane.begin(waiting.pop())
            busy = [lane for lane in self._lanes if lane.unit is not None]
            if not busy:
                return
            patience_s = latest - time.monotonic()
            ready = wait([lane.pipe for lane in busy], min(max(0.0, patience_s), 3600.0))
            for lane in busy:
                if lane.pipe in ready:
                    yield lane.take()
                elif patience_s <= 0.0:
                    lane.end()


class _Lane:
    def __init__(self, job: str, folder: str, scratch: str) -> None:
        self.pipe, theirs = multiprocessing.Pipe()
        # No daemon: files from outside are read by processes of its own.
        fresh = multiprocessing.get_context("spawn")
        self.process = fresh.Process(target=_serve, args=(theirs, job, folder, scratch))
        self.process.start()
        theirs.close()
        self.unit: Unit | None = None

    def begin(self, unit: Unit) -> None:
        self.unit = unit
        with suppress(OSError):  # a process that is gone is told when its answer is taken
            self.pipe.send(unit)

    def take(self) -> tuple[Unit, Mapping[str, Any]]:
        unit, self.unit = self.unit, None
        assert unit is not None
        try:
            return unit, self.pipe.recv()
        except (EOFError, OSError):
            self.end()
            broken = {"failed": "broken", "broken": DIED, "s": None, "took": 0.0}
            return unit, {setting.name: broken for setting in unit.settings}

    def end(self) -> None:
        self.unit = None
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: Connection, job: str, folder: str, scratch: str) -> None:
    """Answers units until the other end is gone. Ctrl-C is the parent's to handle."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(EOFError, OSError):
        while True:
            unit: Unit = pipe.recv()
            pipe.send(
                _measure(_context(job, folder, unit.base.name, tuple(unit.base.changes.items())), unit, Path(scratch))
            )


def _measure(context: WorkerContext, unit: Unit, scratch: Path) -> Mapping[str, Any]:
    """The parts are imported where they run: captures load what scenes have no use for."""
    from services.study.measure import LIMIT, RESTS

    LIMIT["s"], RESTS["folder"] = unit.limit_s, scratch
    if unit.part == "capture":
        from services.study.captures import measure_capture

        return measure_capture(context, unit.settings, unit.scene_id, unit.number, scratch)
    from services.study.images import measure_colour, measure_drawn, measure_look
    from services.study.measure import measure_again, measure_rest

    parts = {
        "rest": measure_rest,
        "again": measure_again,
        "draw": measure_drawn,
        "colour": measure_colour,
        "look": measure_look,
    }
    return parts[unit.part](context, unit.settings, unit.scene_id, unit.number)


@cache
def _opened(job: str, folder: str) -> WorkerContext:
    """The worker of the job itself, after a scene of one object that compiles its loops and shaders."""
    parsed = Job.model_validate_json(job)
    context = open_worker(parsed, open_catalogue(parsed.assets, Path(folder), tuple(parsed.categories)))
    if parsed.captures is None:
        from services.study.measure import warm_up

        warm_up(context)
    return context


_based: dict[str, WorkerContext] = {}


def _context(job: str, folder: str, name: str, changes: tuple[tuple[str, Any], ...]) -> WorkerContext:
    """The job's worker, or for a base setting one of the same process with its job; one object each, because caches know it."""
    own = _opened(job, folder)
    if not changes:
        return own
    if name not in _based:
        _based[name] = replace(own, job=apply(own.job, dict(changes)))
    return _based[name]


# ---------------------------------------------------------------------------------------------- the journal

JOURNAL_FILE = "journal.jsonl"


class Journal(dict[str, Any], AbstractContextManager):
    """Answers by the unit's name, one JSON line each; the first line identifies the study.

    A line that the end of a process cut off is dropped, and its unit measured again.
    """

    def __init__(self, folder: Path, header: Mapping[str, Any]) -> None:
        """Raises OutputError where the folder cannot be written, or holds another study."""
        self._path = folder / JOURNAL_FILE
        super().__init__()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open("a+b")
        except OSError as error:
            raise OutputError(f"{folder} cannot be written: {error.strerror or error}; choose another --out") from error
        try:
            self._read(header)
        except BaseException:
            self._file.close()
            raise

    def _read(self, header: Mapping[str, Any]) -> None:
        self._file.seek(0)
        written = self._file.read()
        whole = written[: written.rfind(b"\n") + 1]
        self._file.truncate(len(whole))
        if not whole:
            self._write(header)
            return
        first, *entries = map(json.loads, whole.splitlines())
        wanted = json.loads(json.dumps(header))
        if other := sorted(key for key in {*first, *wanted} if first.get(key) != wanted.get(key)):
            raise OutputError(
                f"{self._path.parent} holds the measurements of another study (other {', '.join(other)}): choose another "
                f"--out, or delete {self._path.name} there"
            )
        self.update((entry["unit"], entry["answer"]) for entry in entries)

    def add(self, unit: str, answer: Any) -> None:
        """Keep an answer, on disk too."""
        self[unit] = answer
        self._write({"unit": unit, "answer": answer})

    def _write(self, entry: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(entry, sort_keys=True).encode() + b"\n")
        self._file.flush()

    def __exit__(self, *_: object) -> None:
        self._file.close()
