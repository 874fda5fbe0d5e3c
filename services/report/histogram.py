"""Counts of a figure over equal steps, added up batch by batch. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

FINE = 960
"""Number of equal steps that are counted: a multiple of every number of bars that a chart may have."""

LEAST_STEPS = FINE // 10
"""A window is at least so wide: values that are all equal are seen as one bar with room beside it."""


@dataclass(frozen=True)
class Histogram:
    """Values in [low, high], in `FINE` steps; what is outside counts in the first or the last."""

    low: float
    high: float
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(FINE, np.int64))
    total: float = 0.0
    least: float = np.inf
    most: float = -np.inf

    def add(self, values: ArrayLike) -> "Histogram":
        """The histogram with these values too; NaN is left out."""
        array = np.asarray(values, np.float64).ravel()
        array = array[~np.isnan(array)]
        if not array.size:
            return self
        step = np.clip((array - self.low) / (self.high - self.low) * FINE, 0, FINE - 1).astype(np.int64)
        counts = self.counts + np.bincount(step, minlength=FINE)
        total = self.total + float(array.sum())
        return Histogram(
            self.low, self.high, counts, total, min(self.least, float(array.min())), max(self.most, float(array.max()))
        )

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.counts.sum())

    @property
    def mean(self) -> float:
        """The mean of all values; NaN of none."""
        return self.total / self.count if self.count else float("nan")

    def percentile(self, share: float) -> float:
        """The value below which this share (0 to 1) lies, exact to a step; NaN of none."""
        if not self.count:
            return float("nan")
        used = np.flatnonzero(self.counts)
        at = int(np.searchsorted(np.cumsum(self.counts), share * self.count))
        if at in (used[0], used[-1]):  # a share of 1 that most values have is told as 1
            return self.least if at == used[0] and len(used) > 1 else self.most
        value = self.low + (min(at, FINE - 1) + 0.5) * (self.high - self.low) / FINE
        return float(np.clip(value, self.least, self.most))

    def bars(self, window: "Window") -> NDArray[np.int64]:
        """[n] counts of the bars of a window."""
        stop = window.first + window.width * window.number
        padded = np.pad(self.counts[window.first : stop], (0, max(0, stop - FINE)))
        return padded.reshape(window.number, window.width).sum(axis=1)

    def edge(self, window: "Window", bar: int) -> float:
        """The value at the left edge of a bar; of bar `number`, the end of the last."""
        return self.low + (window.first + bar * window.width) * (self.high - self.low) / FINE


@dataclass(frozen=True)
class Window:
    """Equal bars over a part of the steps: the first step, steps in a bar, number of bars."""

    first: int
    width: int
    number: int


def window_of(histograms: Sequence[Histogram], bars: int) -> Window:
    """About `bars` bars over the steps that any of these histograms, of one range, occupies, and over `LEAST_STEPS`."""
    used = np.flatnonzero(np.sum([one.counts for one in histograms], axis=0))
    if not used.size:
        return Window(0, FINE // bars, bars)
    low, high = int(used[0]), int(used[-1]) + 1
    short = max(0, LEAST_STEPS - (high - low))
    low = max(0, min(low - short // 2, FINE - LEAST_STEPS))
    high = max(high, low + min(LEAST_STEPS, FINE))
    width = max(1, -(-(high - low) // bars))
    first = low // width * width
    return Window(first, width, -(-(high - first) // width))
