"""How long work shows that it goes on: a bar on a terminal, one line a minute elsewhere; one JSON line an event in _logs."""

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

LINE_EVERY_S = 60.0
LOG_BYTES = 4 * 2**20
LOG_FILES = 5

_events = logging.getLogger("verso.events")
_events.propagate = False


class ProgressLine:
    """Scenes, or other units, done out of those asked, on standard error."""

    def __init__(self, asked: int, what: str, unit: str = "scene") -> None:
        self._asked = asked
        self._what = what
        self._unit = unit
        self._bar = tqdm(total=asked, unit=unit, desc=what, file=sys.stderr) if sys.stderr.isatty() else None
        self._begun = self._told = time.monotonic()

    def expect(self, asked: int) -> None:
        """More is to be done than was known at first."""
        self._asked = asked
        if self._bar is not None:
            self._bar.total = asked

    def show(self, done: int, failed: int | None = None) -> None:
        """Tell how far it is; `failed` where that is counted."""
        if self._bar is not None:
            self._bar.n = done
            self._bar.set_postfix({} if failed is None else {"failed": failed}, refresh=True)
            return
        now = time.monotonic()
        if now - self._told >= LINE_EVERY_S:
            self._told = now
            rate, told = done / (now - self._begun), "" if failed is None else f"{failed} failed, "
            print(
                f"{self._what}: {done} of {self._asked} {self._unit}s, {told}{rate:.1f} {self._unit}s/s",
                file=sys.stderr,
            )

    def close(self) -> None:
        """Leave the terminal tidy."""
        if self._bar is not None:
            self._bar.close()


@contextmanager
def event_log(out: Path) -> Iterator[None]:
    """Within the block `log_event` writes to OUT/_logs/verso.jsonl, rotated."""
    folder = out / LOG_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
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
    """One event as a JSON line: job, range, scene and attempt where they apply."""
    if not _events.handlers:
        return
    stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    _events.log(
        level, json.dumps({"time": stamp, "level": logging.getLevelName(level).lower(), "event": event, **fields})
    )
