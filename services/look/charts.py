"""Histograms: counts over equal steps, added up batch by batch, and HTML figures of them with SVG bars. Pure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.errors import number

FINE = 960
"""Number of equal steps that are counted: a multiple of every number of bars that a chart may have."""

DEPTH_M = (0.0, 9.6)
"""Range of counted depth, metres: stored depth ends at 8 m by default."""


@dataclass(frozen=True)
class Histogram:
    """Values in [low, high], in `FINE` steps; what is outside counts in the first or the last."""

    low: float
    high: float
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(FINE, np.int64))
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
        ends = min(self.least, float(array.min())), max(self.most, float(array.max()))
        return Histogram(self.low, self.high, counts, *ends)

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.counts.sum())

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


def bars_of(histograms: Sequence[Histogram], most_bars: int) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
    """([n + 1] edges, [n] counts of each histogram) of equal bars over the steps that these histograms, of one range, occupy."""
    used = np.flatnonzero(np.sum([histogram.counts for histogram in histograms], axis=0))
    low, high = (int(used[0]), int(used[-1]) + 1) if used.size else (0, FINE)
    width = -(-(high - low) // most_bars)
    first = low // width * width
    starts = np.arange(first, high, width)
    step = (histograms[0].high - histograms[0].low) / FINE
    edges = histograms[0].low + step * np.append(starts, starts[-1] + width)
    return edges, [np.add.reduceat(histogram.counts[:high], starts) for histogram in histograms]


BARS = 40

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


def chart_html(chart: Chart) -> str:
    """A figure with bars, the ends and the middle of its axis, and its median and spread in words.

    Values that are all equal, or nearly all, are a sentence and no bar. Empty without values.
    """
    series = {name: histogram for name, histogram in chart.series.items() if histogram.count}
    lines = [(name, _summary(chart, histogram)) for name, histogram in series.items()]
    if not lines:
        return ""
    words = "".join(_legend(at, *line) for at, line in enumerate(lines))
    head = f"<figcaption><h3>{escape(chart.title)}</h3><p>{escape(chart.about)}</p></figcaption>\n"
    varies = any(one.percentile(0.05) < one.percentile(0.95) for one in series.values())
    drawn = _drawing(chart, series, lines) if varies else ""
    return f'<figure class="chart">{head}{drawn}<dl>{words}</dl></figure>\n'


def _drawing(chart: Chart, series: Mapping[str, Histogram], lines: Sequence[tuple[str, str]]) -> str:
    """The bars, and the ends and the middle of their axis."""
    edges, counts = bars_of(list(series.values()), BARS)
    most = int(np.max(counts))
    words = "; ".join(f"{name}: {line}" if name else line for name, line in lines)
    drawn = _bars(chart, edges, counts[0], most) + "".join(_line(others, most) for others in counts[1:])
    ticks = (edges[0], (edges[0] + edges[-1]) / 2, edges[-1])
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none" role="img" '
        f'aria-label="{escape(f"{chart.title}. {words}")}">{drawn}</svg>\n'
        f'<div class="ticks">{"".join(f"<span>{escape(chart.tell(tick))}</span>" for tick in ticks)}</div>\n'
    )


def _bars(chart: Chart, edges: NDArray[np.float64], counts: NDArray[np.int64], most: int) -> str:
    """Filled bars; `most` is the count of the highest bar."""
    step, unit = WIDTH / len(counts), (HEIGHT - 4) / most
    bars = []
    for i in np.flatnonzero(counts).tolist():
        span = f"{chart.tell(edges[i])} to {chart.tell(edges[i + 1])}: {counts[i]:,}"
        height = counts[i] * unit
        place = f'x="{(i + 0.06) * step:.2f}" y="{HEIGHT - height:.1f}" width="{step * 0.88:.2f}" height="{height:.1f}"'
        bars.append(f'<rect class="bar" {place}><title>{escape(span)}</title></rect>')
    return "".join(bars)


def _line(counts: NDArray[np.int64], most: int) -> str:
    """A line of steps."""
    step, tops = WIDTH / len(counts), HEIGHT - counts * (HEIGHT - 4) / most
    path = f"M0 {HEIGHT}" + "".join(f"V{top:.1f}H{(i + 1) * step:.1f}" for i, top in enumerate(tops))
    return f'<path class="line" vector-effect="non-scaling-stroke" d="{path}V{HEIGHT}"/>'


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
