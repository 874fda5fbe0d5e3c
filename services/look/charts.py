"""Histograms: counts over equal steps, added up batch by batch, and HTML figures of them with SVG bars. Pure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.errors import number

FINE = 960
"""Number of equal steps that are counted: a multiple of every number of bars that a chart may have."""


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
    """About `bars` bars over the steps that any of these histograms, of one range, occupies."""
    used = np.flatnonzero(np.sum([one.counts for one in histograms], axis=0))
    if not used.size:
        return Window(0, FINE // bars, bars)
    low, high = int(used[0]), int(used[-1]) + 1
    width = max(1, -(-(high - low) // bars))
    first = low // width * width
    return Window(first, width, -(-(high - first) // width))


BARS = 40
_LENGTHS = ((1e3, "m"), (1.0, "mm"), (1e-3, "µm"), (1e-6, "nm"))

WIDTH, HEIGHT = 400, 120
"""Of the drawing, which is stretched to the space that it has."""


@dataclass(frozen=True)
class Chart:
    """One figure over its values: a histogram for each role, all of one range."""

    title: str
    series: Mapping[str, Histogram]
    about: str
    """What the figure is, in a sentence."""
    tell: Callable[[float], str]
    """A value of the histogram in words, with its unit."""
    note: str = ""
    """What is told of values that the histograms do not have."""


def chart_html(chart: Chart) -> str:
    """A figure with bars, the ends and the middle of its axis, and its median and spread in words.

    Values that are all equal, or nearly all, are a sentence and no bar. Empty without values.
    """
    series = {name: histogram for name, histogram in chart.series.items() if histogram.count}
    lines = [(name, _summary(chart, one)) for name, one in series.items()]
    words = "".join(_legend(at, *line) for at, line in enumerate(lines)) + (
        _legend(0, "", chart.note) if chart.note else ""
    )
    if not words:
        return ""
    head = f"<figcaption><h3>{escape(chart.title)}</h3><p>{escape(chart.about)}</p></figcaption>\n"
    varies = any(one.percentile(0.05) < one.percentile(0.95) for one in series.values())
    drawn = _drawing(chart, series, lines) if varies else ""
    return f'<figure class="chart">{head}{drawn}<dl>{words}</dl></figure>\n'


def _drawing(chart: Chart, series: Mapping[str, Histogram], lines: Sequence[tuple[str, str]]) -> str:
    """The bars, and the ends and the middle of their axis."""
    window = window_of(list(series.values()), BARS)
    most = max(int(one.bars(window).max()) for one in series.values())
    first = next(iter(series.values()))
    ends = [first.edge(window, 0), first.edge(window, window.number)]
    ticks = [ends[0], sum(ends) / 2, ends[1]]
    told = "; ".join(f"{name}: {line}" if name else line for name, line in lines)
    drawn = "".join(_draw(chart, one, window, most, at) for at, one in enumerate(series.values()))
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none" role="img" '
        f'aria-label="{escape(f"{chart.title}. {told}")}">{drawn}</svg>\n'
        f'<div class="ticks">{"".join(f"<span>{escape(chart.tell(tick))}</span>" for tick in ticks)}</div>\n'
    )


def _draw(chart: Chart, one: Histogram, window: Window, most: int, at: int) -> str:
    """Filled bars for the first series, a line of steps for the others; `most` is the count of the highest bar."""
    counts = one.bars(window).tolist()
    step, unit = WIDTH / len(counts), (HEIGHT - 4) / max(most, 1)
    tops = [HEIGHT - count * unit for count in counts]
    if at:
        path = f"M0 {HEIGHT}" + "".join(f"V{top:.1f}H{(i + 1) * step:.1f}" for i, top in enumerate(tops))
        return f'<path class="line" vector-effect="non-scaling-stroke" d="{path}V{HEIGHT}"/>'
    bars = []
    for i, (top, count) in enumerate(zip(tops, counts, strict=True)):
        if not count:
            continue
        span = f"{chart.tell(one.edge(window, i))} to {chart.tell(one.edge(window, i + 1))}: {count:,}"
        place = f'x="{i * step + step * 0.06:.2f}" y="{top:.1f}" width="{step * 0.88:.2f}" height="{HEIGHT - top:.1f}"'
        bars.append(f'<rect class="bar" {place}><title>{escape(span)}</title></rect>')
    return "".join(bars)


def _summary(chart: Chart, one: Histogram) -> str:
    if one.least == one.most:
        return f"always {chart.tell(one.least)}, n = {one.count:,}"
    low, middle, high = (chart.tell(one.percentile(share)) for share in (0.05, 0.5, 0.95))
    if one.percentile(0.05) == one.percentile(0.95):
        return f"nearly always {middle}; {chart.tell(one.least)} to {chart.tell(one.most)}, n = {one.count:,}"
    return f"median {middle}, 5 to 95 %: {low} to {high}, n = {one.count:,}"


def _legend(at: int, name: str, line: str) -> str:
    mark = f'<dt class="{"line" if at else "bar"}">{escape(name)}</dt>' if name else "<dt></dt>"
    return f"<div>{mark}<dd>{escape(line)}</dd></div>"


def amount(value: float, unit: str) -> str:
    """Three digits and the unit; a degree sign stands at its number."""
    return f"{number(float(f'{value:.3g}'))}{'' if unit == '°' else ' '}{unit}"


def length_of_decade(decade: float) -> str:
    """The length of a power of ten of a millimetre: "1 nm", "31.6 µm"."""
    mm = float(10.0**decade)
    return next(amount(mm / one, unit) for one, unit in _LENGTHS if mm >= one * 0.9995 or unit == "nm")
