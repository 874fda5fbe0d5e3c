"""Which attempts have stalled: their workers show no change for longer than a scene may take. Pure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Stall:
    """An attempt that shows no change for `idle_s` seconds; None: in that time there was no attempt at all."""

    attempt: AttemptName | None
    scene_id: int | None
    idle_s: float


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
    factors = {True: COMMIT_FACTOR, False: SCENE_FACTOR}
    return {
        attempt: seen[attempt]
        for attempt in _latest(seen)
        if seen[attempt].idle_s > factors[seen[attempt].scene_id is None] * scene_timeout_s
    }


def _latest(seen: Mapping[AttemptName, Sight]) -> Iterable[AttemptName]:
    latest: dict[int, AttemptName] = {}
    for attempt in sorted(seen):
        other = latest.get(attempt.start)
        if other is None or seen[attempt].idle_s < seen[other].idle_s:
            latest[attempt.start] = attempt
    return latest.values()
