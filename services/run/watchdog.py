"""The watchdog: finds workers that show no change for longer than a scene may take, by what they note. Edge.

It stands outside the workers, so it also sees one that was stopped, or that hangs while it writes or commits.
"""

import contextlib
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from services.run.machine import Process, descendants, read_process, send
from workers.store.attempt import blamed_scene, staged_attempts
from workers.store.store import Store

SCENE_FACTOR = 1.5
"""Share of run.scene_timeout_s that computing and writing one scene may take: a worker that computes ends itself at 1."""

COMMIT_FACTOR = 5.0
"""The same between scenes, where a range is made durable and committed."""


@dataclass(frozen=True, order=True)
class AttemptName:
    """An attempt at the range from `start`."""

    start: int
    name: str

    @property
    def host(self) -> str:
        """The host of its worker, as attempts are named: with `_` for what is no letter, digit, `_` or `.`."""
        return self.name.split("-")[-3]

    @property
    def pid(self) -> int:
        """The process id of its worker, on its host."""
        return int(self.name.split("-")[-2])


@dataclass(frozen=True)
class Sight:
    """What was last seen of an attempt: the scene in progress (None between scenes), and for how long it is the same."""

    scene_id: int | None
    idle_s: float = 0.0


def look(
    before: Mapping[AttemptName, Sight], now: Mapping[AttemptName, int | None], passed_s: float
) -> dict[AttemptName, Sight]:
    """What is known after another look, `passed_s` after the one `before`: `now` is the scene in progress of each attempt."""
    known = {}
    for attempt, scene_id in now.items():
        earlier = before.get(attempt)
        same = earlier is not None and earlier.scene_id == scene_id
        known[attempt] = Sight(scene_id, earlier.idle_s + passed_s if earlier is not None and same else 0.0)
    return known


def find_stalls(seen: Mapping[AttemptName, Sight], scene_timeout_s: float) -> dict[AttemptName, Sight]:
    """The attempts that have shown no change for too long.

    Of several attempts at one range, the one that changed last is the one that counts: workers of others were lost.
    """
    by_age = sorted(seen.items(), key=lambda item: (item[1].idle_s, item[0]), reverse=True)
    latest = {attempt.start: (attempt, sight) for attempt, sight in by_age}
    factors = {True: COMMIT_FACTOR, False: SCENE_FACTOR}
    return {
        attempt: sight
        for attempt, sight in latest.values()
        if sight.idle_s > factors[sight.scene_id is None] * scene_timeout_s
    }


LOOKS = 12
"""Looks in the time that a scene may take at most."""

MOST_LOOKS_AT_ONCE = 3
"""A pause between two looks counts as at most this many: in a longer one this process was suspended itself."""

Stall = tuple[AttemptName | None, Sight]
"""An attempt that shows no change, and what is the same for so long; None: in that time there was no attempt at all."""


@contextlib.contextmanager
def watch(store: Store, label: str, scene_timeout_s: float) -> Iterator[Callable[[], list[Stall]]]:
    """Looks at a coordinator's attempts, known by their `label`, in a thread while the block lasts.

    What comes back takes the stalls that were found since its last call.
    """
    stalls: deque[Stall] = deque()
    over = threading.Event()
    settings = store, label, scene_timeout_s, stalls, over
    threading.Thread(target=_watch, args=settings, name="watchdog", daemon=True).start()
    try:
        yield lambda: [stalls.popleft() for _ in range(len(stalls))]
    finally:
        over.set()


def _watch(store: Store, label: str, scene_timeout_s: float, stalls: deque[Stall], over: threading.Event) -> None:
    period_s = SCENE_FACTOR * scene_timeout_s / LOOKS
    seen: dict[AttemptName, Sight] = {}
    last, empty_s = time.monotonic(), 0.0
    while not over.wait(period_s):
        with contextlib.suppress(Exception):  # a store that does not answer now may do so at the next look
            scenes = scenes_in_progress(store, label)
            now = time.monotonic()
            passed_s, last = min(now - last, MOST_LOOKS_AT_ONCE * period_s), now
            seen = look(seen, scenes, passed_s)
            for attempt, sight in find_stalls(seen, scene_timeout_s).items():
                stalls.append((attempt, sight))
                seen[attempt] = Sight(sight.scene_id)
            empty_s = 0.0 if seen else empty_s + passed_s
            if empty_s > COMMIT_FACTOR * scene_timeout_s:
                stalls.append((None, Sight(None, empty_s)))
                empty_s = 0.0


def scenes_in_progress(store: Store, label: str) -> dict[AttemptName, int | None]:
    """The scene in progress (None between scenes) of every attempt with this label that has not ended."""
    staged = staged_attempts(store)
    return {AttemptName(start, name): blamed_scene(store, start, name) for start, name in staged if label in name}


def find_own_workers() -> list[Process]:
    """Workers of this process's own Ray."""
    return [process for process in descendants(os.getpid()) if _is_worker(process.pid)]


def end_worker_here(pid: int) -> bool:
    """Kills a Ray worker of this machine; False where the id is none of a Ray worker. To be run on the worker's node."""
    process = read_process(pid)
    if process is None or pid == os.getpid() or not _is_worker(pid):
        return False
    send(process, signal.SIGKILL)
    return True


def _is_worker(pid: int) -> bool:
    """Whether Ray gave the process a title."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::")
    return False
