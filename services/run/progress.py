"""Progress of long work: a bar on a terminal, soon one line a minute elsewhere, and one JSON line an event in OUT/_logs."""

import json
import logging
import logging.handlers
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from schemas.dataset.layout import LOG_FOLDER
from schemas.errors import describe_seconds
from services.run.supervisor import tell
from workers.store.file_system import refuse_link_out

FIRST_LINES_S = (3.0, 8.0, 15.0, 30.0)
"""Seconds after which a log has its first lines; then one every `LINE_EVERY_S`."""

LINE_EVERY_S = 60.0
USUAL_COLUMNS, USUAL_ROWS = 80, 24
"""Size of a terminal that tells none: tqdm draws nothing in one without rows."""

LOG_BYTES = 4 * 2**20
LOG_FILES = 5

_events = logging.getLogger("verso.events")
_events.propagate = False


class ProgressLine:
    """Shows on standard error how many scenes, or other units, are done out of those asked, at what rate, and the time left."""

    def __init__(self, asked: int, what: str, unit: str = "scene") -> None:
        self._asked = asked
        self._what = what
        self._unit = unit
        self._bar = (
            tqdm(total=asked, unit=unit, desc=what, file=sys.stderr, ncols=_columns(), nrows=USUAL_ROWS)
            if sys.stderr.isatty()
            else None
        )
        self._begun = time.monotonic()
        self._lines = 0

    def expect(self, asked: int) -> None:
        """Sets the number to be done, where more is known than at first."""
        self._asked = asked
        if self._bar is not None:
            self._bar.total = asked

    def show(self, done: int, failed: int | None = None, name: str = "") -> None:
        """Shows the number done, `failed` where failures are counted, and the name of the last one where it has one."""
        if self._bar is not None:
            self._bar.n = done
            self._bar.set_postfix(
                {"last": name} if name else {} if failed is None else {"failed": failed}, refresh=True
            )
            return
        passed_s = time.monotonic() - self._begun
        if passed_s >= _line_s(self._lines):
            while passed_s >= _line_s(self._lines):
                self._lines += 1
            last = f", last {name}" if name else ""
            print(f"{self._what}: {_tell(done, self._asked, self._unit, failed, passed_s)}{last}", file=sys.stderr)

    def close(self) -> None:
        """Ends the bar."""
        if self._bar is not None:
            self._bar.close()


@contextmanager
def show_counts(of: str, unit: str = "file") -> Iterator[Callable[[str, int, int], None]]:
    """Within the block, what comes back shows numbers of several kinds: it takes the kind, how many are done, and of how many."""
    lines = dict[str, ProgressLine]()

    def watch(what: str, done: int, asked: int) -> None:
        if what not in lines:
            lines[what] = ProgressLine(asked, f"{of} {what}", unit)
        lines[what].expect(asked)
        lines[what].show(done)

    try:
        yield watch
    finally:
        for line in lines.values():
            line.close()


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or USUAL_COLUMNS
    except OSError:
        return USUAL_COLUMNS


def _line_s(number: int) -> float:
    """Seconds from the start after which a log has this line, from 0."""
    more = number - len(FIRST_LINES_S) + 1
    return FIRST_LINES_S[number] if more <= 0 else LINE_EVERY_S * more


def _tell(done: int, asked: int, unit: str, failed: int | None, passed_s: float) -> str:
    """`9 of 20 scenes, 1 failed, 0.4 scenes/s, 28 s left`."""
    parts = [f"{done} of {asked} {unit}s", *([] if failed is None else [f"{failed} failed"])]
    if done:
        rate = done / passed_s
        parts += [f"{rate:.1f} {unit}s/s", f"{describe_seconds(max(0, asked - done) / rate)} left"]
    return ", ".join(parts)


def say(line: str) -> None:
    """Prints a message while a bar may be shown."""
    tqdm.write(f"verso: {line}", file=sys.stderr)


@contextmanager
def event_log(out: Path | None) -> Iterator[None]:
    """Within the block `log_event` writes to OUT/_logs/verso.jsonl, rotated; nowhere without an `out` on a disk."""
    if out is None:
        yield
        return
    folder = out / LOG_FOLDER
    refuse_link_out(out, f"{LOG_FOLDER}/verso.jsonl")
    folder.mkdir(parents=True, exist_ok=True)
    tell(logs=str(folder))
    handler = logging.handlers.RotatingFileHandler(
        folder / "verso.jsonl", maxBytes=LOG_BYTES, backupCount=LOG_FILES - 1
    )
    _events.addHandler(handler)
    _events.setLevel(logging.INFO)
    try:
        yield
    finally:
        _events.removeHandler(handler)
        handler.close()


def log_event(event: str, level: int = logging.INFO, **fields: Any) -> None:
    """Writes one event as a JSON line: job, range, scene and attempt where they apply."""
    if not _events.handlers:
        return
    stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    _events.log(
        level, json.dumps({"time": stamp, "level": logging.getLevelName(level).lower(), "event": event, **fields})
    )
