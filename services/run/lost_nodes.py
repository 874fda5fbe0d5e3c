"""Which hosts a cluster has lost, and which shards were lost with them.

Ray tells at once of a worker whose connection was reset. Of one behind a network that was cut it says nothing until TCP
gives up, a quarter of an hour later, although it counts the node as dead after one minute.
"""

import time
from collections.abc import Callable, Collection, Iterable

from schemas.dataset.commit import Span
from services.run.stalls import AttemptName
from workers.store.attempt import attempts_at
from workers.store.commit import read_record
from workers.store.store import Store

LOOK_EVERY_S = 2.0
"""How often the cluster is asked for its nodes."""


class LostNodes:
    """Tells each host once when its last node is gone; `alive` names the hosts that have a node now."""

    def __init__(self, alive: Callable[[], Collection[str]], clock: Callable[[], float] = time.monotonic) -> None:
        self._alive = alive
        self._clock = clock
        self._known: set[str] = set()
        self._looked_s = float("-inf")

    def take(self) -> set[str]:
        """The hosts that had a node at the last look and have none now."""
        if self._clock() - self._looked_s < LOOK_EVERY_S:
            return set()
        self._looked_s = self._clock()
        now = set(self._alive())
        lost, self._known = self._known - now, now
        return lost


def hosts_of(store: Store, label: str, spans: Iterable[Span]) -> set[str]:
    """The hosts whose workers have begun these ranges, by what they left: attempts with this label, and commits by them."""
    names = []
    for span in spans:
        names += [(span.start, name) for name in attempts_at(store, span.start)]
        record = read_record(store, span.start, span.retry)
        names += [(span.start, record.attempt)] if record is not None else []
    return {AttemptName(start, name).host for start, name in names if label in name}
