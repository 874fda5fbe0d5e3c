"""The watchdog: looks at what workers note about their scenes, and ends those that show no change. Edge.

It stands outside the workers, so it also sees one that was stopped, or that hangs while it writes or commits.
"""

import contextlib
import os
import queue
import signal
import threading
import time
from pathlib import Path
from types import TracebackType

from services.run.processes import Process, descendants, read_process, send
from services.run.stalls import COMMIT_FACTOR, SCENE_FACTOR, AttemptName, Sight, Stall, find_stalls, look
from workers.store.attempt import blamed_scene, staged_attempts
from workers.store.store import Store

LOOKS = 12
"""Looks in the time that a scene may take at most."""

MOST_LOOKS_AT_ONCE = 3
"""A pause between two looks counts as at most this many: in a longer one this process was suspended itself."""


_WORKER_TITLE = b"ray::"


class Watchdog:
    """Looks at the attempts of one coordinator, known by their `label`, in a thread of its own while a block lasts."""

    def __init__(self, store: Store, label: str, scene_timeout_s: float) -> None:
        self._store = store
        self._label = label
        self._scene_timeout_s = scene_timeout_s
        self._stalls: queue.SimpleQueue[Stall] = queue.SimpleQueue()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def __enter__(self) -> "Watchdog":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()

    def take_stalls(self) -> list[Stall]:
        """The stalls found since the last call."""
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._stalls.get_nowait())
        return found

    def _watch(self) -> None:
        period_s = SCENE_FACTOR * self._scene_timeout_s / LOOKS
        seen: dict[AttemptName, Sight] = {}
        last, empty_s = time.monotonic(), 0.0
        while not self._over.wait(period_s):
            with contextlib.suppress(Exception):  # a store that does not answer now may do so at the next look
                scenes = scenes_in_progress(self._store, self._label)
                now = time.monotonic()
                passed_s, last = min(now - last, MOST_LOOKS_AT_ONCE * period_s), now
                seen = look(seen, scenes, passed_s)
                for attempt, sight in find_stalls(seen, self._scene_timeout_s).items():
                    self._stalls.put(Stall(attempt, sight.scene_id, sight.idle_s))
                    seen[attempt] = Sight(sight.scene_id)
                empty_s = 0.0 if seen else empty_s + passed_s
                if empty_s > COMMIT_FACTOR * self._scene_timeout_s:
                    self._stalls.put(Stall(None, None, empty_s))
                    empty_s = 0.0


def scenes_in_progress(store: Store, label: str) -> dict[AttemptName, int | None]:
    """The scene in progress (None between scenes) of every attempt with this label that has not ended."""
    own = (AttemptName(start, name) for start, name in staged_attempts(store) if label in name)
    return {attempt: blamed_scene(store, attempt.start, attempt.name) for attempt in own}


def find_own_workers() -> list[Process]:
    """Workers of this process's own Ray: descendants that Ray gave a title."""
    return [process for process in descendants(os.getpid()) if _title(process.pid).startswith(_WORKER_TITLE)]


def end_worker_here(pid: int) -> bool:
    """Kills a Ray worker of this machine; False where the id is none of a Ray worker. To be run on the worker's node."""
    process = read_process(pid)
    if process is None or pid == os.getpid() or not _title(pid).startswith(_WORKER_TITLE):
        return False
    send(process, signal.SIGKILL)
    return True


def _title(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""
