"""Locks that another machine takes over."""

import contextlib
from collections.abc import Iterator

import pytest

from services.run import lock as module
from services.run.lock import Beat, Lock, hold_lock
from workers.store.store import Store

FAST = Beat(period_s=0.02, patience=15)
STILL = Beat(period_s=0.02 * 3600, patience=1)
"""A heartbeat that does not come while a test lasts."""


@contextlib.contextmanager
def taken_over(store: Store) -> Iterator[Lock]:
    """Another machine finds the holder silent and takes the lock over; yields its lock."""
    with contextlib.ExitStack() as stack:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "_machine", lambda: "another")
            patch.setattr(module.socket, "gethostname", lambda: "far")
            theirs = stack.enter_context(hold_lock(store, FAST))
        yield theirs
