"""Edge: a driver's share of the cluster, read from the queue every few seconds."""

import contextlib
import time
from collections.abc import Callable
from typing import Final

from schemas.errors import VersoError
from services.queue.store import Queue

EVERY_S: Final = 5.0
"""Between two looks."""


class Sharing:
    """Called, it gives the number of jobs that share the cluster; what was read last where storage does not answer."""

    def __init__(self, queue: Queue, clock: Callable[[], float] = time.monotonic) -> None:
        self._queue = queue
        self._clock = clock
        self._jobs = 1
        self._read_at = float("-inf")

    def __call__(self) -> int:
        """At least 1."""
        if self._clock() - self._read_at >= EVERY_S:
            self._read_at = self._clock()
            with contextlib.suppress(VersoError, OSError):
                self._jobs = self._queue.share()
        return self._jobs
