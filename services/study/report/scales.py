"""Pure: logarithmic axes that a person reads: few round ticks, and a place for errors of 0."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

ROOM = 0.06
"""Of an axis's length that is left free at each end."""

ZERO_GAP = 0.16
"""Of the axis's length between the least error above 0 and the place of 0."""

MOST_TICKS = 6

_DIGITS = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))
"""First digits of ticks in a decade, from few to many."""


@dataclass(frozen=True)
class Scale:
    """A logarithmic axis from `low` to `high`; what is 0 is drawn at `zero`, below all the rest, if there is such."""

    low: float
    high: float
    ticks: tuple[float, ...]
    zero: float | None = None

    def place(self, value: float) -> float:
        """Where a value is drawn: what is below the axis, such as the lower end of an interval, at its lower end."""
        if value <= 0.0:
            return self.low if self.zero is None else self.zero
        return max(value, self.low)


def scale_of(values: Sequence[float]) -> Scale:
    """An axis for values from 0 up, which holds all of them with room at both ends. Raises ValueError for none at all."""
    positive = [value for value in values if value > 0.0]
    if not values:
        raise ValueError("an axis needs a value")
    least, most = (min(positive), max(positive)) if positive else (0.1, 1.0)
    if most / least < 1.3:  # a single value, or such as are the same but for noise
        least, most = least / 1.3, most * 1.3
    decades = math.log10(most / least)
    zero = None
    low = least
    if len(positive) < len(values):
        zero = low = least / 10 ** (decades * ZERO_GAP / (1 - ZERO_GAP))
        decades = math.log10(most / low)
    low, high = low / 10 ** (decades * ROOM), most * 10 ** (decades * ROOM)
    return Scale(low, high, round_ticks(low if zero is None else math.sqrt(zero * least), high), zero)


def round_ticks(low: float, high: float) -> tuple[float, ...]:
    """From three to six round numbers within [low, high], both above 0, spread as a logarithmic axis asks."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in _DIGITS:
        ticks = [digit * 10.0**decade for decade in decades for digit in digits]
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) >= 3:
            every = math.ceil(len(inside) / MOST_TICKS)
            return tuple(inside[::every])
    return _linear_ticks(low, high)


def _linear_ticks(low: float, high: float) -> tuple[float, ...]:
    """Where the axis is short: every 1, 2 or 5 of something."""
    rough = (high - low) / MOST_TICKS
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(digit * unit for digit in (1.0, 2.0, 5.0, 10.0) if digit * unit >= rough)
    first, last = math.ceil(low / step), math.floor(high / step)
    return tuple(count * step for count in range(first, last + 1))
