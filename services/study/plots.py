"""The plots of a study: what accuracy costs in time, and each knob by itself."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any, Literal

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.cbook import pts_to_poststep
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from matplotlib.transforms import Bbox

from schemas.errors import milliseconds, number
from services.study.choose import FEWEST_SCENES, front, own_row, tells
from services.study.model import ERRORS, NEGLIGIBLE, Figure, Row, Study, as_often, cost, short, shown, unit

_PHYSICS = "pose_mm outcome_mm penetration_mm gap_mm moved_mm unbalanced_share turned_deg outcome_deg"

PARTS = (
    ("at rest", "How objects rest", _PHYSICS),
    ("in depth", "Depth and masks", "between_mm depth_mm outline_share mask_share table_depth_mm"),
    ("in the mirror", "The other side", "mirror_mm agreement_mm unfilled_share hidden_share"),
    ("in colour", "Colour", "flip edge_flip"),
    ("in the poses", "Camera poses", "camera_mm camera_deg"),
    ("in the cloud", "Merged cloud", "cloud_mm cloud_p95_mm"),
    ("in completeness", "What is missing", "missing_share"),
    ("in new views", "Synthesised views", "view_depth_mm"),
)
"""Each part of a scene: its name in the title, its heading, and its errors. The panel shows the first that settings move."""

MOVED = 0.05
"""A knob that moves an error by no more than this share of the job's own is left out of its panel."""

MOST_ERRORS = 3
"""The most errors that a knob's picture shows: those that move most."""

REACH = 4.0
"""An axis is cut where an interval reaches beyond this many times its middle, which would otherwise fill the axis."""

TRADEOFF_FILE = "tradeoff.png"

DOTS = 150
"""An inch. A picture 12 inches wide has 1,800 pixels, sharp where it is shown at 1,200."""

INK, PALE = "#222222", "#777777"

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#6F6800")
"""Okabe and Ito's palette for colour-blind readers, the yellow darker so that it is seen on white."""

MARKERS = ("o", "^", "s", "v", "P", "X")
"""One fewer than the colours, so that 42 knobs look different."""

Mark = dict[str, Any]
"""Properties of a marker."""

OWN: Mark = {"color": "black", "marker": "*", "ms": 16.0, "mec": "white", "zorder": 5}
PRESET: Mark = {"color": "black", "marker": "s", "ms": 10.0, "mfc": "none", "mew": 1.5, "zorder": 4.5}
SEVERAL: Mark = {"color": PALE, "marker": "d", "ms": 6.5, "mfc": "white", "zorder": 3}
SINGLE: Mark = {"ms": 6.5, "mec": "white", "mew": 0.6, "zorder": 4}

KINDS = {"own": ("the job as it is", OWN), "preset": ("preset", PRESET), "several": ("several knobs at once", SEVERAL)}
"""The names and marks of settings that are not one knob's."""

PLAIN = {"font.family": "DejaVu Sans", "font.size": 9.5, "axes.edgecolor": "#888888"}
"""The font and the size of texts, whatever the user's matplotlibrc says."""

Label = tuple[str, tuple[float, float]]
"""A text and the point, in data coordinates, that it stands beside."""


@dataclass(frozen=True)
class Panel:
    """What a panel shows: an error, and the cheapest setting with at most half of the job's own, if any."""

    name: str
    heading: str
    error: str
    half: Row | None


@style.context(["default", PLAIN])
def write_plots(study: Study, folder: Path) -> list[Path]:
    """Write tradeoff.png and knob_NAME.png for each knob that moves an error; returns their paths, tradeoff.png first."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {folder / TRADEOFF_FILE: draw_tradeoff(study)}
    for knob in single_knobs(study.rows):
        if moved_errors(study.rows, knob):
            name = "".join(letter if letter.isalnum() else "_" for letter in knob)
            pictures[folder / f"knob_{name}.png"] = draw_knob(study, knob)
    for path, picture in pictures.items():
        # Neither a date nor the library's name, so that the same study gives the same bytes.
        picture.savefig(path, dpi=DOTS, metadata={"Software": None})
    return list(pictures)


# ---------------------------------------------------------------------------------------------- all settings


def panels_of(rows: Sequence[Row]) -> list[Panel]:
    """One for each part of a scene in which a setting moved an error; where there is none, those of the job alone."""
    panels: dict[bool, list[Panel]] = {True: [], False: []}
    for name, heading, errors in PARTS:
        measured = [error for error in errors.split() if any(error in row.errors for row in rows)]
        moved = [error for error in measured if len(moving_rows(rows, error)) > 1]
        for error in (moved or measured)[:1]:
            panels[bool(moved)].append(Panel(name, heading, error, half_row(rows, error)))
    return panels[True] or panels[False]


def moving_rows(rows: Sequence[Row], error: str) -> list[Row]:
    """The settings that a panel shows.

    The job, presets, knobs of which a value moves the error by more than `MOVED` and what is negligible, and combinations with
    such a knob.
    """
    measured = [row for row in rows if error in row.errors]
    own, least = own_row(rows).errors.get(error), NEGLIGIBLE[ERRORS[error].unit]
    moving = {
        row.setting.knob
        for row in measured
        if row.setting.kind == "single"
        and (own is None or abs(row.errors[error].value - own.value) > max(MOVED * own.value, least))
    }
    return [row for row in measured if row.setting.kind in ("own", "preset") or set(dict(row.setting.parts)) & moving]


def half_row(rows: Sequence[Row], error: str) -> Row | None:
    """The cheapest setting that measured at most half of the job's own error, and less than that with its whole interval."""
    if not tells(own_row(rows), error):
        return None
    own = own_row(rows).errors[error]
    if own.value <= NEGLIGIBLE[ERRORS[error].unit]:
        return None
    halves = [row for row in front(rows, error) if row.errors[error].value <= own.value / 2]
    return next((row for row in halves if is_less(row.errors[error], own.value)), None)


def is_less(figure: Figure, value: float) -> bool:
    """Whether an error is less than the job's, which is a value, with its whole interval, and in most scenes by themselves."""
    return figure.high <= value and figure.less is not False


@style.context(["default", PLAIN])
def draw_tradeoff(study: Study) -> Picture:
    """A panel for each part of a scene: its main error over processor time, both logarithmic."""
    panels = panels_of(study.rows)
    core = cut(str(study.machine.get("cpu", "an unknown processor")), 60)
    sample = f"{cut(study.job, 40)}: {study.sample}; one core of {core}"
    draws = [partial(_draw_panel, study, panel) for panel in panels]
    return _draw_panels(f"{headline(study, panels)}\n{sample}", draws, min(2, len(panels)), (12.0, 4.6))


def headline(study: Study, panels: Sequence[Panel]) -> str:
    """What half of each error costs, in one line."""
    costs = [f"{cost(panel.half.ratio)} {panel.name}" for panel in panels if panel.half is not None]
    found = f"half the error takes {', '.join(costs)}" if costs else "no setting that was measured halves an error"
    return f"A scene takes {milliseconds(own_row(study.rows).ms)}; {found}"


def _draw_panel(study: Study, panel: Panel, axes: Axes) -> list[Label]:
    """Points by knob, their intervals, and the front; returns the labels, first those that matter most."""
    rows, error, knobs = moving_rows(study.rows, panel.error), panel.error, single_knobs(study.rows)
    best = front(rows, error)
    axes.set_title(f"{panel.heading}: {_message(study.rows, panel)}", loc="left", fontsize=11)
    _set_axes(axes, [row.ms for row in rows], rows, error)
    if best:
        corners = pts_to_poststep(*zip(*(_place_of(row, error) for row in best), strict=True))
        axes.plot(*corners, color=INK, lw=1.3, zorder=2, label="front: none is cheaper and better")
    for kind, (title, mark) in KINDS.items():
        _draw_rows(axes, [row for row in rows if row.setting.kind == kind], error, title, mark)
    for knob in single_knobs(rows):
        look = knobs.index(knob)
        mark = {**SINGLE, "color": COLORS[look % len(COLORS)], "marker": MARKERS[look % len(MARKERS)]}
        _draw_rows(axes, knob_rows(rows, knob), error, cut(knob), mark)
    # A combination has a long name, which the page tells.
    named = [row for row in rows if row.setting.kind != "several"]
    named.sort(key=lambda row: (row.setting.kind == "single" and row is not panel.half, row not in best))
    return [_label(row, error) for row in named]


def _message(rows: Sequence[Row], panel: Panel) -> str:
    """What a smaller error costs, as far as its whole interval lies below the job's own."""
    own, error = own_row(rows), panel.error
    if panel.half is not None:
        return f"half the error takes {cost(panel.half.ratio)}"
    if error in own.errors and own.errors[error].value <= NEGLIGIBLE[ERRORS[error].unit]:
        return "the job's own is negligible"
    if error not in own.errors:
        return "nothing better was measured"
    if not tells(own, error):
        return "too few scenes to tell"
    mine = own.errors[error].value
    better = [row for row in front(rows, error) if is_less(row.errors[error], mine * (1.0 - MOVED))]
    if not better:
        return "nothing is surely better"
    return f"{100 * (1.0 - better[-1].errors[error].value / mine):.2g} % less error takes {cost(better[-1].ratio)}"


# ---------------------------------------------------------------------------------------------- each knob by itself


def single_knobs(rows: Sequence[Row]) -> list[str]:
    """Knobs that were turned by themselves, in the order of the table."""
    return list(dict.fromkeys(row.setting.knob for row in rows if row.setting.kind == "single"))


def knob_rows(rows: Sequence[Row], knob: str) -> list[Row]:
    """The settings that turn this knob alone, in the order of the table: from coarse to fine."""
    return [row for row in rows if row.setting.kind == "single" and row.setting.knob == knob]


def moved_errors(rows: Sequence[Row], knob: str) -> list[str]:
    """The errors that a knob was seen to move, the one that moves farthest first."""
    turned, own = knob_rows(rows, knob), own_row(rows)
    spread = {}
    for name in dict.fromkeys(name for row in turned for name in row.errors):
        values = [row.errors[name].value for row in [own, *turned] if name in row.errors]
        if max(values) > min(values) * (1 + MOVED):
            spread[name] = math.inf if min(values) <= 0 else max(values) / min(values)
    return sorted(spread, key=lambda name: -spread[name])


@style.context(["default", PLAIN])
def draw_knob(study: Study, knob: str) -> Picture:
    """One panel for each of the errors that the knob moves most, of at least one."""
    errors, ratios = moved_errors(study.rows, knob)[:MOST_ERRORS], [row.ratio for row in knob_rows(study.rows, knob)]
    ends = dict.fromkeys((as_often(min(ratios)), as_often(max(ratios))))
    draws = [partial(_draw_along, study, knob, error) for error in errors]
    head = f"{cut(knob)}: {' to '.join(ends)} × the job's time"
    return _draw_panels(head, draws, len(errors), (4.5 * len(errors), 4.0))


def _draw_along(study: Study, knob: str, error: str, axes: Axes) -> list[Label]:
    """The knob's values joined in their order, with intervals of error and time, and the job as a star; their labels."""
    own = own_row(study.rows)
    turned = [row for row in knob_rows(study.rows, knob) if error in row.errors]
    rows = [own, *turned] if error in own.errors else turned
    spans = [(row.ratio_least * own.ms, row.ratio_most * own.ms) for row in rows]
    _set_axes(axes, [end for span in spans for end in span], rows, error)
    axes.hlines([_place_of(row, error)[1] for row in rows], *zip(*spans, strict=True), color=PALE, lw=0.8)
    _draw_rows(axes, turned, error, cut(knob), {**SINGLE, "color": COLORS[0], "marker": "o", "ls": "-", "lw": 1.0})
    _draw_rows(axes, rows[: len(rows) - len(turned)], error, *KINDS["own"])
    return [_label(row, error) for row in rows]


# ---------------------------------------------------------------------------------------------- axes


def _draw_panels(
    title: str, draws: Sequence[Callable[[Axes], list[Label]]], columns: int, size: tuple[float, float]
) -> Picture:
    """Axes in a grid under one title and over one legend; `size` is the picture's width and a line's height, inches."""
    lines = -(-len(draws) // columns)
    picture = Picture((size[0], lines * size[1] + 1.0), dpi=DOTS, layout="constrained")
    wrapped = "\n".join(fill(line, round(10 * size[0])) for line in title.splitlines())
    picture.suptitle(wrapped, x=0.01, ha="left", fontsize=11, fontweight="bold")
    labels = {}
    for place, draw in enumerate(draws, start=1):
        axes = picture.add_subplot(lines, columns, place)
        labels[axes] = draw(axes)
    entries = {text: handle for axes in labels for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)}
    columns = max(2, round(size[0] / 2.5))
    picture.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False)
    picture.draw_without_rendering()
    picture.set_layout_engine("none")
    for axes, some in labels.items():
        _write_labels(axes, some)
    return picture


def _label(row: Row, error: str) -> Label:
    return cut(row.setting.parts[0][1]) if row.setting.parts else "the job", _place_of(row, error)


def _write_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Labels beside their points, but for those that would cover an earlier one or leave the axes."""
    # No label lies on the star or the square of another setting.
    large = [line for line in axes.get_lines() if line.get_markersize() >= PRESET["ms"]]
    points = [(line.get_markersize() * DOTS / 72, at) for line in large for at in np.array(line.get_xydata(), float)]
    marks = [(tuple(at), _square(axes.transData.transform(at), size)) for size, at in points]
    taken: list[Bbox] = []
    for text, at in labels:
        covered = [box for place, box in marks if place != at]
        # Above on the right the front never runs.
        for sign, side, end in ((1, "left", "bottom"), (-1, "right", "top")):
            place = (6.0 * sign, 3.0 * sign)
            note = axes.annotate(text, at, place, textcoords="offset points", ha=side, va=end, zorder=6)
            box, frame = note.get_window_extent(), axes.get_window_extent()
            if frame.x0 <= box.x0 and box.x1 <= frame.x1 and not box.count_overlaps([*taken, *covered]):
                taken.append(box)
                break
            note.remove()


def _square(centre: np.ndarray, size: float) -> Bbox:
    return Bbox([centre - size / 2, centre + size / 2])


def _draw_rows(axes: Axes, rows: Sequence[Row], error: str, title: str, mark: Mark) -> None:
    """Markers of settings with the intervals of their errors, and an entry of the legend; a ring about those of few scenes."""
    if rows:
        x, y = zip(*(_place_of(row, error) for row in rows), strict=True)
        ends = [(shown(error, row.errors[error].low), shown(error, row.errors[error].bound)) for row in rows]
        low, high = zip(*ends, strict=True)
        axes.vlines(x, low, high, color=mark["color"], lw=0.8, alpha=0.55, label="95 % interval over scenes")
        axes.plot(x, y, label=title, clip_on=False, **{"ls": "", **mark})
        if few := [at for row, at in zip(rows, zip(x, y, strict=True), strict=True) if not tells(row, error)]:
            ring: Mark = {"ls": "", "marker": "o", "mfc": "none", "mec": PALE, "ms": 13.0, "zorder": 2.5}
            axes.plot(*zip(*few, strict=True), label=f"fewer than {FEWEST_SCENES} scenes", clip_on=False, **ring)


def _place_of(row: Row, error: str) -> tuple[float, float]:
    """Where a setting stands in a plot of an error: milliseconds, and the error in the unit it is shown in."""
    return row.ms, shown(error, row.errors[error].value)


def _set_axes(axes: Axes, ms: Sequence[float], rows: Sequence[Row], error: str) -> None:
    """Logarithmic axes with few round ticks and their units; they hold the times and the errors of the rows.

    Intervals are held as far as they reach no further than `REACH` times.
    """
    figures = [row.errors[error] for row in rows]
    ends = [end for one in figures for end in (max(one.low, one.value / REACH), min(one.bound, one.value * REACH))]
    values = [one.value for one in figures] + [end for end in ends if end > 0.0]
    _set_scale(axes, "x", ms)
    _set_scale(axes, "y", [shown(error, value) for value in values])
    axes.set(xlabel="ms of processor a scene", ylabel=", ".join(filter(None, [short(error), unit(error)])))
    axes.grid(color="#e8e8e8")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _set_scale(axes: Axes, side: Literal["x", "y"], values: Sequence[float]) -> None:
    """A logarithmic axis with room for all values; linear from 0 to the least above 0 where one is 0."""
    positive = [value for value in values if value > 0.0] or [0.1, 1.0]
    low, high = min(positive), max(positive)
    if high / low < 1.3:  # a single value, or values that differ by noise
        low, high = low / 1.3, high * 1.3
    room = (high / low) ** 0.06
    scale: dict[str, Any] = {"value": "log"}
    ends, ticks = (low / room, high * room), round_ticks(low / room, high * room)
    if len(positive) < len(values) or min(values) == 0.0:
        # A sixth of the axis lies between 0 and the least value.
        scale = {"value": "symlog", "linthresh": low, "linscale": 0.2 * math.log10(high / low)}
        ends, ticks = (-0.3 * low, high * room), [0.0, *(tick for tick in ticks if tick >= low)]
    (axes.set_xscale if side == "x" else axes.set_yscale)(**scale)
    axes.set(**{f"{side}lim": ends})
    axis = axes.xaxis if side == "x" else axes.yaxis
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))


def round_ticks(low: float, high: float) -> list[float]:
    """From two to seven round numbers within [low, high], both above 0, spread evenly over a logarithmic axis."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)):
        inside = [tick for n in decades for digit in digits if low <= (tick := digit * 10.0**n) <= high]
        if len(inside) >= 3:
            return inside[:: math.ceil(len(inside) / 6)]
    return [float(tick) for tick in MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(low, high) if low <= tick <= high]


def cut(words: str, most: int = 26) -> str:
    """At most so many letters, the last of them "…" where there were more; the page has the words whole."""
    return words if len(words) <= most else f"{words[: most - 1].rstrip()}…"
