"""Where the time of a scene goes, by stage and by effect."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Stopwatch:
    """Seconds by stage, and by effect where an effect has a time of its own; what runs twice adds up.

    Stages follow one another and sum up to the scene; an effect's time lies within those of stages.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    effects: dict[str, float] = field(default_factory=dict)
    now: Callable[[], float] = time.perf_counter
    """`time.process_time` counts this process's own time, all its threads together."""

    def stage(self, name: str, effect: str | None = None) -> AbstractContextManager[None]:
        """Adds the time of a block to the stage, and to the effect that the block is the work of."""
        return self._time((self.seconds, name), (self.effects, effect))

    def effect(self, name: str) -> AbstractContextManager[None]:
        """Adds the time of a block, which has stages of its own, to the effect."""
        return self._time((self.effects, name))

    @contextmanager
    def _time(self, *entries: tuple[dict[str, float], str | None]) -> Iterator[None]:
        begun = self.now()
        try:
            yield
        finally:
            elapsed = self.now() - begun
            for clock, name in entries:
                if name is not None:
                    clock[name] = clock.get(name, 0.0) + elapsed

    def add(self, other: "Stopwatch") -> None:
        """Adds the stages of another stopwatch."""
        for name, seconds in other.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
