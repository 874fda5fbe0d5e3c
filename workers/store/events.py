"""Numbered events in a store: each is put if absent at the next number, never changed, and state is the fold of them.

Writers decide on what they read and take the next number; whoever loses it reads and decides again. So no two events are
decided on the same state, however many processes and machines append, and no clock is compared.
"""

import time
from collections.abc import Callable, Sequence

from schemas.errors import CorruptError
from workers.store.store import Store

LONGEST_PAUSE_S = 1.0
"""Between two tries to append: over NFS, a listing may be old for some seconds."""


class Events:
    """The events below `folder`, files named by their number with eight digits."""

    def __init__(self, store: Store, folder: str) -> None:
        self._store = store
        self._folder = folder
        self._known: dict[int, bytes] = {}
        """Events that were read, by number: they never change."""

    def read(self) -> list[bytes]:
        """All events from the first. Raises CorruptError where one is missing, or the folder holds what is none."""
        names = self._store.names(self._folder)
        if names != [event_path("", number)[1:] for number in range(len(names))]:
            raise CorruptError(f"{self._store.name}/{self._folder} lacks an event, or holds what is none")
        return [self._read(number) for number in range(len(names))]

    def append(self, decide: Callable[[Sequence[bytes]], bytes | None]) -> list[bytes] | None:
        """Adds the event that `decide` makes of all events before it, and returns all; None where it makes none.

        `decide` is called again where another writer took the number. Two writers must never make the same bytes: an event
        needs a nonce.
        """
        pause_s = 0.01
        while True:
            before = self.read()
            event = decide(before)
            if event is None:
                return None
            if self._store.put_if_absent(event_path(self._folder, len(before)), event):
                return [*before, event]
            time.sleep(pause_s)
            pause_s = min(LONGEST_PAUSE_S, 2 * pause_s)

    def _read(self, number: int) -> bytes:
        if number not in self._known:
            self._known[number] = self._store.read(event_path(self._folder, number))
        return self._known[number]


def event_path(folder: str, number: int) -> str:
    """The key of event `number`, from 0, of the log in a folder; keys sort as their numbers."""
    return f"{folder}/{number:08d}.json"
