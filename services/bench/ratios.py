"""Pure: from the times of rounds to the figures of the report."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median


@dataclass(frozen=True)
class Spread:
    """A figure over rounds: its median, its least and its greatest."""

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, figures: Sequence[float]) -> "Spread":
        """Raises ValueError where there is none."""
        if not figures:
            raise ValueError("a spread of no figures")
        return cls(median(figures), min(figures), max(figures))


@dataclass(frozen=True)
class Lap:
    """One side's part of a round: how long it took for how many scenes, and of that how long by stage.

    wall_s by the clock; cpu_s of the processor, which neighbours on the machine disturb less and waiting for the disk
    does not show in; apart_s of the clock for work that is not in wall_s: the script loads each scene's meshes before.
    """

    scenes: int
    wall_s: float
    cpu_s: float
    stages_s: Mapping[str, float]
    apart_s: float = 0.0

    @property
    def slope_s(self) -> float:
        """Seconds for one scene more: no start-up is in it."""
        return self.wall_s / self.scenes


Slope = Callable[[Lap], float]


def by_clock(lap: Lap) -> float:
    """Seconds for one scene more."""
    return lap.slope_s


def by_processor(lap: Lap) -> float:
    """Seconds of processor for one scene more."""
    return lap.cpu_s / lap.scenes


def with_loading(lap: Lap) -> float:
    """Seconds for one scene more, what is done apart included."""
    return (lap.wall_s + lap.apart_s) / lap.scenes


def slope_ratio(slow: Sequence[Lap], fast: Sequence[Lap], slope: Slope = by_clock) -> Spread:
    """How many times as many scenes `fast` makes in the same time: of each pair of laps, taken side by side."""
    return Spread.of([slope(a) / slope(b) for a, b in zip(slow, fast, strict=True)])


def stage_table(laps: Sequence[Lap], middle: Callable[[list[float]], float] = median) -> dict[str, float]:
    """Milliseconds per scene by stage, the median over laps; `rest` is the remainder.

    With `middle=mean` a stage that few scenes have, such as casting rays, shows what it costs all of them.
    """
    names = list(dict.fromkeys(name for lap in laps for name in lap.stages_s))
    table = {name: middle([lap.stages_s.get(name, 0.0) / lap.scenes * 1e3 for lap in laps]) for name in names}
    table["rest"] = middle([(lap.wall_s - sum(lap.stages_s.values())) / lap.scenes * 1e3 for lap in laps])
    return table


def idle_share(shard_wall_s: float, slots: int, run_wall_s: float) -> float:
    """Share of the slots' time in which no shard ran: what handing out the work, and its uneven end, cost."""
    return 1.0 - shard_wall_s / (slots * run_wall_s)


def growth(samples: Sequence[float], window: int) -> float:
    """How far the last `window` samples lie above the first, by medians: 0.05 is 5 % more."""
    return median(samples[-window:]) / median(samples[:window]) - 1.0
