"""What all pictures share: style, canvas, colours, axes, and boxes of what is drawn in pixels."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

from matplotlib import rc_context, style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure as Picture
from matplotlib.figure import SubFigure
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from matplotlib.transforms import Bbox

from services.study.model import Row
from services.study.report.scales import Scale, scale_of
from services.study.words import number, short, shown, unit

DOTS = 150
"""An inch. A picture 12 inches wide has 1,800 pixels, sharp where it is shown at 1,200."""

INK, PALE, GRID = "#222222", "#777777", "#e8e8e8"

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#F0E442")
"""Okabe and Ito's palette, told apart by colour-blind people too; knobs have a marker each besides."""

TEXT_COLORS = ("#005A8E", "#A84A00", "#00694D", "#9A4476", "#1F77AE", "#8A5F00", "#6F6800")
"""The same, dark enough to read on white."""

MARKERS = ("o", "^", "s", "D", "v", "P", "X")

REACH = 4.0
"""An interval that reaches further than this many times its middle is cut at the axes' edge, or it alone would be seen."""

_PIECE = 6.0
"""Pixels of a slanted line that are taken for one box."""


def single_look(look: int) -> dict[str, Any]:
    """The marker of a knob; the pale colour has an edge that is seen on white."""
    edge = TEXT_COLORS[look] if COLORS[look] == "#F0E442" else "white"
    return {"marker": MARKERS[look], "ms": 7.0 if MARKERS[look] in "PX" else 6.0, "mec": edge, "mew": 0.6}


@contextmanager
def plain_style() -> Iterator[None]:
    """Whatever a user's matplotlibrc says: the library's own style, and the font that it ships."""
    with (
        style.context("default"),
        rc_context({"font.family": "DejaVu Sans", "font.size": 9.5, "axes.edgecolor": "#888888"}),
    ):
        yield


def new_picture(width: float, height: float) -> Picture:
    """An empty picture in inches, on a canvas of its own: no window, and no state that others share."""
    picture = Picture(figsize=(width, height), dpi=DOTS, facecolor="white")
    FigureCanvasAgg(picture)
    return picture


def renderer_of(picture: Picture | SubFigure) -> RendererAgg:
    """What measures texts in pixels."""
    canvas = picture.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    return canvas.get_renderer()


def fit(text: Text, most: float) -> None:
    """Make a line smaller until it is at most so many pixels wide."""
    assert text.figure is not None
    renderer = renderer_of(text.figure)
    # Step by step, because hinting makes small letters wider than their share.
    while (wide := text.get_window_extent(renderer).width) > most:
        text.set_fontsize(float(text.get_fontsize()) * min(most / wide, 0.98))


def cut(words: str, most: int) -> str:
    """At most so many letters, the last of them "…" where there were more."""
    return words if len(words) <= most else f"{words[: most - 1].rstrip()}…"


def set_axes(axes: Axes, across: Scale, up: Scale, error: str) -> None:
    """Logarithmic axes with few round ticks, "0" at the bottom where an error is, and units in words."""
    axes.set(xscale="log", yscale="log", xlim=(across.low, across.high), ylim=(up.low, up.high))
    for axis, scale in ((axes.xaxis, across), (axes.yaxis, up)):
        axis.set_major_locator(FixedLocator([*([] if scale.zero is None else [scale.zero]), *scale.ticks]))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda at, _, zero=scale.zero: "0" if at == zero else number(at)))
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(color="#888888", labelsize=9)
    axes.set_xlabel("ms of processor a scene", fontsize=9.5, color=INK)
    axes.set_ylabel(f"{short(error)}{f', {unit(error)}' if unit(error) else ''}", fontsize=9.5, color=INK)
    if up.zero is not None:
        axes.axhline(up.zero, color="#bbbbbb", lw=0.8, ls=(0, (4, 3)), zorder=1)


def place_of(row: Row, error: str, up: Scale) -> tuple[float, float]:
    """Where a setting stands in a picture of an error: milliseconds, and the error in the unit it is shown in."""
    return row.ms, up.place(shown(error, row.errors[error].value))


def up_scale(rows: Sequence[Row], error: str) -> Scale:
    """For an error of settings that measured it, with their intervals as far as they reach no further than `REACH` times."""
    figures = [row.errors[error] for row in rows]
    ends = [end for one in figures for end in (max(one.low, one.value / REACH), min(one.high, one.value * REACH))]
    values = [one.value for one in figures] + [end for end in ends if end > 0.0]
    return scale_of([shown(error, value) for value in values])


def boxed(axes: Axes, at: tuple[float, float], half: float) -> Bbox:
    """The box in pixels of a marker at a place in data coordinates, `half` points to each side."""
    (x, y), reach = axes.transData.transform(at), half * DOTS / 72
    return Bbox.from_bounds(x - reach, y - reach, 2 * reach, 2 * reach)


def pieces(axes: Axes, corners: Sequence[tuple[float, float]]) -> list[Bbox]:
    """A line through places in data coordinates, as boxes in pixels that hold it closely."""
    places, boxes = [axes.transData.transform(corner) for corner in corners], []
    for (ax, ay), (bx, by) in pairwise(places):
        count = 1 + int(min(abs(bx - ax), abs(by - ay)) / _PIECE)
        for n in range(count):
            xs, ys = ([a + (b - a) * (n + k) / count for k in (0, 1)] for a, b in ((ax, bx), (ay, by)))
            boxes.append(Bbox.from_extents(min(xs), min(ys), max(xs), max(ys)))
    return boxes
