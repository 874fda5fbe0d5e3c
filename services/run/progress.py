"""Progress of long work: a bar on a terminal, one line a minute elsewhere, and one JSON line an event in OUT/_logs."""

import json
import logging
import logging.handlers
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from schemas.dataset.layout import LOG_FOLDER
from services.run.supervisor import tell
from workers.store.file_system import refuse_link_out

LINE_EVERY_S = 60.0
LOG_BYTES = 4 * 2**20
LOG_FILES = 5

_events = logging.getLogger("verso.events")
_events.propagate = False


class ProgressLine:
    """Shows on standard error how many scenes, or other units, are done out of those asked."""

    def __init__(self, asked: int, what: str, unit: str = "scene") -> None:
        self._asked = asked
        self._what = what
        self._unit = unit
        self._bar = tqdm(total=asked, unit=unit, desc=what, file=sys.stderr) if sys.stderr.isatty() else None
        self._begun = self._shown = time.monotonic()

    def expect(self, asked: int) -> None:
        """Sets the number to be done, where more is known than at first."""
        self._asked = asked
        if self._bar is not None:
            self._bar.total = asked

    def show(self, done: int, failed: int | None = None) -> None:
        """Shows the number done, and `failed` where failures are counted."""
        if self._bar is not None:
            self._bar.n = done
            self._bar.set_postfix({} if failed is None else {"failed": failed}, refresh=True)
            return
        now = time.monotonic()
        if now - self._shown >= LINE_EVERY_S:
            self._shown = now
            rate, failures = done / (now - self._begun), "" if failed is None else f"{failed} failed, "
            print(
                f"{self._what}: {done} of {self._asked} {self._unit}s, {failures}{rate:.1f} {self._unit}s/s",
                file=sys.stderr,
            )

    def close(self) -> None:
        """Ends the bar."""
        if self._bar is not None:
            self._bar.close()


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
