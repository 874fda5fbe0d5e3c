"""Style, palette, axes and labels of all plots.

- Labels beside the points of a plot, placed where they hide nothing.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from matplotlib import rc_context, style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure as Picture
from matplotlib.figure import SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from matplotlib.transforms import Bbox

from services.study.model import Row
from services.study.words import number, short, shown, unit

DOTS = 150
"""An inch. A picture 12 inches wide has 1,800 pixels, sharp where it is shown at 1,200."""

INK, PALE, GRID = "#222222", "#777777", "#e8e8e8"

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#F0E442")
"""Okabe and Ito's palette for colour-blind readers; each knob also has a marker of its own."""

TEXT_COLORS = ("#005A8E", "#A84A00", "#00694D", "#9A4476", "#1F77AE", "#8A5F00", "#6F6800")
"""The same hues, dark enough for text on white."""

MARKERS = ("o", "^", "s", "D", "v", "P", "X")

REACH = 4.0
"""The axis is cut where an interval reaches beyond this many times its middle, which would otherwise fill the axis."""

ROOM = 0.06
"""Share of an axis's length that stays free at each end."""

ZERO_GAP = 0.16
"""Share of an axis's length between 0 and the least error above 0."""

MOST_TICKS = 6

_FIRST_DIGITS = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))
"""First digits of ticks in a decade, from few to many."""


@contextmanager
def plain_style() -> Iterator[None]:
    """Uses the library's own style and font, whatever the user's matplotlibrc says."""
    with (
        style.context("default"),
        rc_context({"font.family": "DejaVu Sans", "font.size": 9.5, "axes.edgecolor": "#888888"}),
    ):
        yield


def new_picture(width: float, height: float, head: float, foot: float = 0.0) -> Picture:
    """An empty picture in inches, laid out between `head` and `foot` inches; it has no window and no shared state."""
    between = (0.0, foot / height, 1.0, 1 - (head + foot) / height)
    layout = ConstrainedLayoutEngine(rect=between, w_pad=0.08, h_pad=0.1, wspace=0.03, hspace=0.03)
    picture = Picture(figsize=(width, height), dpi=DOTS, facecolor="white", layout=layout)
    FigureCanvasAgg(picture)
    return picture


def renderer_of(picture: Picture | SubFigure) -> RendererAgg:
    """The renderer that measures texts in pixels."""
    canvas = picture.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    return canvas.get_renderer()


def write_head(picture: Picture, words: str, down: float, **look: Any) -> None:
    """A line of text `down` inches below the top, made smaller until it fits."""
    width, height = picture.get_size_inches()
    text: Text = picture.text(0.15 / width, 1 - down / height, words, va="top", **look)
    most, renderer = (width - 0.3) * DOTS, renderer_of(picture)
    # Step by step, because hinting makes small letters wider than their share.
    while (wide := text.get_window_extent(renderer).width) > most:
        text.set_fontsize(float(text.get_fontsize()) * min(most / wide, 0.98))


def cut(words: str, most: int = 26) -> str:
    """At most so many letters, the last of them "…" where there were more; the page has the words whole."""
    return words if len(words) <= most else f"{words[: most - 1].rstrip()}…"


def place_of(row: Row, error: str) -> tuple[float, float]:
    """Where a setting stands in a plot of an error: milliseconds, and the error in the unit it is shown in."""
    return row.ms, shown(error, row.errors[error].value)


def set_axes(axes: Axes, ms: Sequence[float], rows: Sequence[Row], error: str) -> None:
    """Logarithmic axes with few round ticks and their units; they hold the times and the errors of the rows.

    Intervals are held as far as they reach no further than `REACH` times.
    """
    figures = [row.errors[error] for row in rows]
    ends = [end for one in figures for end in (max(one.low, one.value / REACH), min(one.high, one.value * REACH))]
    values = [one.value for one in figures] + [end for end in ends if end > 0.0]
    set_scale(axes, "x", ms)
    set_scale(axes, "y", [shown(error, value) for value in values])
    axes.set_xlabel("ms of processor a scene", color=INK)
    axes.set_ylabel(", ".join(filter(None, [short(error), unit(error)])), color=INK)
    axes.grid(color=GRID)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def set_scale(axes: Axes, side: Literal["x", "y"], values: Sequence[float]) -> None:
    """A logarithmic axis with room for all values; linear from 0 to the least above 0 where one is 0.

    Raises ValueError for no values.
    """
    if not values:
        raise ValueError("an axis needs a value")
    positive = [value for value in values if value > 0.0]
    least, most = (min(positive), max(positive)) if positive else (0.1, 1.0)
    if most / least < 1.3:  # a single value, or values that differ by noise
        least, most = least / 1.3, most * 1.3
    decades = math.log10(most / least)
    gap = decades * ZERO_GAP / (1 - ZERO_GAP) if len(positive) < len(values) else 0.0
    room = ROOM * (decades + gap)
    low, high = least / 10**room, most * 10**room
    ticks = round_ticks(low, high)
    scale: dict[str, Any] = {"value": "log"}
    if gap:
        # A symmetric scale draws 10/9 of `linscale` decades between 0 and `linthresh`.
        scale = {"value": "symlog", "linthresh": least, "linscale": 0.9 * gap}
        low, ticks = -least * room / gap, (0.0, *(tick for tick in ticks if tick >= least))
    (axes.set_xscale if side == "x" else axes.set_yscale)(**scale)
    axes.set(**{f"{side}lim": (low, high)})
    axis = axes.xaxis if side == "x" else axes.yaxis
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axis.set_tick_params(length=0 if side == "y" else 3, color=PALE)


def round_ticks(low: float, high: float) -> tuple[float, ...]:
    """From two to seven round numbers within [low, high], both above 0, spread evenly over a logarithmic axis."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in _FIRST_DIGITS:
        inside = [tick for n in decades for digit in digits if low <= (tick := digit * 10.0**n) <= high]
        if len(inside) >= 3:
            return tuple(inside[:: math.ceil(len(inside) / MOST_TICKS)])
    linear = MaxNLocator(MOST_TICKS, steps=[1, 2, 5, 10]).tick_values(low, high)
    return tuple(float(tick) for tick in linear if low <= tick <= high)


def draw_row(axes: Axes, row: Row, error: str, color: str, own_ms: float | None = None, **mark: Any) -> None:
    """A setting's marker and the interval of its error, and with `own_ms` also that of its time."""
    (x, y), figure = place_of(row, error), row.errors[error]
    spans = [([x, x], [shown(error, figure.low), shown(error, figure.high)])]
    if own_ms is not None:
        spans.append(([row.ratio_least * own_ms, row.ratio_most * own_ms], [y, y]))
    for span in spans:
        axes.plot(*span, color=color, lw=0.8, alpha=0.55, zorder=2.5)
    axes.plot([x], [y], ls="", color=color, clip_on=False, **mark)


SPACE_X, SPACE_Y = 5.0, 1.0
"""Pixels kept free around a label: more at its sides, so that two do not read as one."""

_DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Right of the point first, then left, above, below and the corners."""

_DISTANCES = (6.5, 9.0, 16.0, 26.0, 38.0)
"""Points from the middle of the marker to the label."""

_LED = 16.0
"""From this distance on a line leads to the label."""

ON_LINE = 12.0
"""Points of distance that a label accepts to avoid one line."""


@dataclass(frozen=True)
class Label:
    """A text beside a point of an axes, in data coordinates; the lowest rank is placed first.

    `must`: bold, and may stand at any of the distances.
    """

    text: str
    at: tuple[float, float]
    color: str
    rank: float
    must: bool = False


def place_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Draw the labels within the axes, over no marker and no other label, and over as few lines as can be.

    A label without room is left out. The axes must have its final place and content.
    """
    taken = [box for line in axes.get_lines() for box in marker_boxes(line)]
    paths = [
        line.get_path().transformed(line.get_transform()) for line in axes.get_lines() if line.get_linestyle() != "None"
    ]
    for label in sorted(labels, key=lambda label: (label.rank, label.text)):
        note = axes.annotate(
            label.text,
            label.at,
            (0.0, 0.0),
            textcoords="offset points",
            color=label.color,
            fontsize=9.0,
            fontweight="bold" if label.must else "normal",
            zorder=6,
            arrowprops={"arrowstyle": "-", "color": label.color, "lw": 0.6, "shrinkA": 0, "shrinkB": 6},
        )
        spots = [(cost, spot, led, _put(axes, note, spot)) for cost, spot, led in _spots(label)]
        free = [
            (cost + ON_LINE * sum(path.intersects_bbox(box, filled=False) for path in paths), spot, led, box)
            for cost, spot, led, box in spots
            if box is not None and not any(box.padded(SPACE_X, SPACE_Y).overlaps(other) for other in taken)
        ]
        if not free:
            note.remove()
            continue
        _, spot, led, box = min(free, key=lambda one: one[0])
        _put(axes, note, spot)
        taken.append(box)
        assert note.arrow_patch is not None
        note.arrow_patch.set_visible(led)


def _spots(label: Label) -> Iterator[tuple[float, dict[str, Any], bool]]:
    """Cost, properties of the text and whether a line leads there, of every place that a label may have."""
    for distance in _DISTANCES if label.must else _DISTANCES[:3]:
        for turn, (x, y) in enumerate(_DIRECTIONS):
            reach = distance * (0.75 if x and y else 1.0)
            side = {"ha": ("center", "left", "right")[x], "va": ("center", "bottom", "top")[y]}
            yield distance + 0.3 * turn, {"position": (x * reach, y * reach), **side}, distance >= _LED


def _put(axes: Axes, note: Annotation, spot: dict[str, Any]) -> Bbox | None:
    """Move the text there; its box in pixels, None where it leaves the axes."""
    renderer = renderer_of(axes.figure)
    note.set(**spot)
    note.update_positions(renderer)
    box, frame = Text.get_window_extent(note, renderer), axes.get_window_extent(renderer)
    inside = box.x0 >= frame.x0 + 2 and box.x1 <= frame.x1 and box.y0 >= frame.y0 + 2 and box.y1 <= frame.y1
    return box if inside else None


def marker_boxes(line: Line2D) -> list[Bbox]:
    """The boxes in pixels of a line's markers."""
    if line.get_marker() in ("None", "", None):
        return []
    half = line.get_markersize() / 2 * DOTS / 72
    return [Bbox([at - half, at + half]) for at in line.get_transform().transform(line.get_xydata())]
