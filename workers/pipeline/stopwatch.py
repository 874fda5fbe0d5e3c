"""Where the time of a scene goes."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Stopwatch:
    """Seconds by stage, and by effect where an effect has a time of its own; what runs twice adds up.

    Stages follow one another and sum up to the scene; an effect's time lies within those of stages.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    effects: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str, effect: str | None = None) -> Iterator[None]:
        """Adds the time of the block to the stage, and to the effect that the block is the work of."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - begun
            self._add(self.seconds, name, elapsed)
            if effect is not None:
                self._add(self.effects, effect, elapsed)

    @contextmanager
    def effect(self, name: str) -> Iterator[None]:
        """Adds the time of the block, which has stages of its own, to the effect."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self._add(self.effects, name, time.perf_counter() - begun)

    def add(self, other: "Stopwatch") -> None:
        """Adds the stages of another stopwatch."""
        for name, seconds in other.seconds.items():
            self._add(self.seconds, name, seconds)

    @staticmethod
    def _add(clock: dict[str, float], name: str, seconds: float) -> None:
        clock[name] = clock.get(name, 0.0) + seconds
