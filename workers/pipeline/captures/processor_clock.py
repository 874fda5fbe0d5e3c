"""Processor time by stage: what a busy machine does not change."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from workers.scene.context import Stopwatch


@dataclass(frozen=True)
class ProcessorClock(Stopwatch):
    """A stopwatch that counts this process's own time, all its threads together."""

    @contextmanager
    def _time(self, *entries: tuple[dict[str, float], str | None]) -> Iterator[None]:
        begun = time.process_time()
        try:
            yield
        finally:
            elapsed = time.process_time() - begun
            for clock, name in entries:
                if name is not None:
                    clock[name] = clock.get(name, 0.0) + elapsed
