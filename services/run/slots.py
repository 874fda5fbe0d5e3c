"""The number of shards that run at once. On a cluster it changes as nodes come and go. Pure."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

PREFETCH = 2
"""Shards given to Ray for each slot: one that runs and one that waits, so that no slot is idle between two."""

LOOK_EVERY_S = 2.0
"""How often a cluster is asked for its cores."""


@dataclass(frozen=True)
class Slots:
    """The number of shards that run at once, and that may be given to Ray at once."""

    running: int
    in_flight: int

    def now(self) -> "Slots":
        """The slots at this moment."""
        return self


def slots_of(cores: int, workers: int | None) -> Slots:
    """The slots of a cluster with that many cores, at least one: `workers` where that is less.

    Any free core would start a waiting shard, so none may wait where there are fewer workers than cores.
    """
    cores = max(1, cores)
    return Slots(workers, workers) if workers and workers < cores else Slots(cores, PREFETCH * cores)


@dataclass(frozen=True)
class ClusterSlots(Slots):
    """The slots of a cluster as they are at first; `look` tells those of the moment."""

    look: Callable[[], Slots]

    @classmethod
    def of(
        cls, count_cores: Callable[[], int], workers: int | None, clock: Callable[[], float] = time.monotonic
    ) -> "ClusterSlots":
        """The slots of a cluster whose cores `count_cores` counts; it is asked every few seconds."""
        known = slots_of(count_cores(), workers)
        at_s = clock()

        def look() -> Slots:
            nonlocal known, at_s
            if clock() - at_s >= LOOK_EVERY_S:
                known, at_s = slots_of(count_cores(), workers), clock()
            return known

        return cls(known.running, known.in_flight, look)

    def now(self) -> Slots:
        """The slots that the cluster has now: at least one, also while it has no node."""
        return self.look()


@dataclass(frozen=True)
class SharedSlots(Slots):
    """Slots that several jobs share evenly, as many as `jobs` tells at the moment."""

    whole: Slots
    jobs: Callable[[], int]

    @classmethod
    def of(cls, whole: Slots, jobs: Callable[[], int]) -> "SharedSlots":
        """A share of all slots of a cluster."""
        return cls(whole.running, whole.in_flight, whole, jobs)

    def now(self) -> Slots:
        """With other jobs an even share, rounded up, of which none waits in Ray: it would take another job's turn."""
        whole, jobs = self.whole.now(), self.jobs()
        if jobs <= 1:
            return whole
        share = math.ceil(whole.running / jobs)
        return Slots(share, share)
