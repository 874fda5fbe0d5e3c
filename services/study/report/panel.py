"""One panel: an error over processor time, a point for each setting that was measured."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.transforms import Bbox

from services.study.choose import front, own_row
from services.study.model import Row, Study
from services.study.report.labels import Label, place_labels
from services.study.report.pictures import (
    COLORS,
    INK,
    PALE,
    TEXT_COLORS,
    boxed,
    cut,
    pieces,
    place_of,
    renderer_of,
    set_axes,
    single_look,
    up_scale,
)
from services.study.report.scales import Scale, scale_of
from services.study.words import cost, shown

_MAIN = (
    (
        "at rest",
        "How objects rest",
        ("pose_mm", "moved_mm", "outcome_mm", "penetration_mm", "gap_mm", "turned_deg", "outcome_deg"),
    ),
    ("in depth", "Depth and masks", ("between_mm", "depth_mm", "outline_share", "mask_share", "table_depth_mm")),
    ("in the mirror", "The other side", ("mirror_mm", "agreement_mm", "unfilled_share", "hidden_share")),
    ("in colour", "Colour", ("flip", "edge_flip")),
)
"""Of each part of a scene its name in the title, its heading, and its main errors: the first that settings move is shown."""


MOVED = 0.05
"""A knob that moves an error by no more than this share of the job's own has nothing to say in its panel."""

LONGEST = 26
"""Letters of a label or of a knob's name; the page has them whole."""


@dataclass(frozen=True)
class Panel:
    """What a panel shows: an error, and the cheapest setting that has at most half of the job's own, if any."""

    name: str
    heading: str
    error: str
    half: Row | None


def panels_of(rows: Sequence[Row]) -> list[Panel]:
    """One for each part of a scene in which a setting moved an error; of the job alone where that is all there is."""
    panels: list[Panel] = []
    alone: list[Panel] = []
    for name, heading, errors in _MAIN:
        measured = [error for error in errors if any(error in row.errors for row in rows)]
        moved = [error for error in measured if len(moving_rows(rows, error)) > 1]
        for error in (moved or measured)[:1]:
            (panels if moved else alone).append(Panel(name, heading, error, half_row(rows, error)))
    return panels or alone


def moving_rows(rows: Sequence[Row], error: str) -> list[Row]:
    """The settings that a panel shows.

    The job, presets, knobs of which a value moves the error by more than `MOVED`, and what turns such a knob and others.
    """
    measured = [row for row in rows if error in row.errors]
    own = own_row(rows).errors.get(error)
    moving = {
        row.setting.parts[0][0]
        for row in measured
        if kind_of(row) == "single" and (own is None or abs(row.errors[error].value - own.value) > MOVED * own.value)
    }
    return [row for row in measured if kind_of(row) in ("own", "preset") or set(dict(row.setting.parts)) & moving]


def half_row(rows: Sequence[Row], error: str) -> Row | None:
    """The cheapest setting that measured at most half of the job's own error."""
    own = own_row(rows).errors.get(error)
    if own is None or own.value <= 0.0:
        return None
    return next((row for row in front(rows, error) if row.errors[error].value <= own.value / 2), None)


Looks = Mapping[str, int]
"""Which colour and marker a knob has."""


def looks_of(rows: Sequence[Row], panels: Sequence[Panel]) -> dict[str, Looks]:
    """By panel's error: no two knobs of one panel look alike, as far as looks go, and a knob looks the same in all."""
    turned = {
        panel.error: list(dict.fromkeys(row.setting.parts[0][0] for row in _singles(rows, panel.error)))
        for panel in panels
    }
    often = Counter(knob for knobs in turned.values() for knob in knobs)
    everywhere: dict[str, int] = {}
    for knob in sorted(often, key=lambda knob: -often[knob]):  # what several panels show chooses first
        beside = {other for knobs in turned.values() if knob in knobs for other in knobs}
        used = Counter(everywhere[other] for other in beside if other in everywhere)
        everywhere[knob] = min(range(len(COLORS)), key=lambda look: (used[look], look))
    return {error: {knob: everywhere[knob] for knob in knobs} for error, knobs in turned.items()}


def _singles(rows: Sequence[Row], error: str) -> list[Row]:
    return [row for row in moving_rows(rows, error) if kind_of(row) == "single"]


def draw_panel(axes: Axes, study: Study, panel: Panel, looks: Looks) -> None:
    """Points, intervals, front, labels, and a heading with its message."""
    rows = moving_rows(study.rows, panel.error)
    across = scale_of([row.ms for row in rows])
    up = up_scale(rows, panel.error)
    set_axes(axes, across, up, panel.error)
    lines = pieces(axes, _draw_front(axes, rows, panel.error, up))
    marks = [_draw_point(axes, row, panel.error, up, looks) for row in rows]
    lines += [piece for row in rows for piece in _draw_interval(axes, row, panel.error, up, looks)]
    _heading(axes, panel.heading, _message(study.rows, panel), 8.0 + 14.0 * _legend(axes, looks))
    place_labels(axes, renderer_of(axes.figure), _labels(rows, panel, up, looks), marks, lines)


def _message(rows: Sequence[Row], panel: Panel) -> str:
    """What less of it costs."""
    best = front(rows, panel.error)[-1]
    if panel.half is not None:
        return f"half the error takes {cost(panel.half.ratio)}"
    own = own_row(rows).errors.get(panel.error)
    if own is None or own.value <= best.errors[panel.error].value:
        return "nothing better was measured"
    less = 1.0 - best.errors[panel.error].value / own.value
    return f"{100 * less:.2g} % less error takes {cost(best.ratio)}"


def _heading(axes: Axes, heading: str, message: str, pad: float) -> None:
    """What the panel is of in bold, and its message after it."""
    title = axes.set_title(heading, loc="left", fontsize=12, fontweight="bold", color=INK, pad=pad)
    axes.annotate(
        message, (1.0, 0.0), (8.0, 0.0), xycoords=title, textcoords="offset points", fontsize=11, color=INK, va="bottom"
    )


def kind_of(row: Row) -> str:
    """Whether a setting is the job ("own"), a preset, one knob turned ("single") or several ("pair")."""
    parts = row.setting.parts
    if not parts:
        return "own"
    return "preset" if parts[0][0] == "preset" else "single" if len(parts) == 1 else "pair"


def _draw_front(axes: Axes, rows: Sequence[Row], error: str, up: Scale) -> list[tuple[float, float]]:
    """A staircase: what is right of it and above is beaten. Returns its corners."""
    best = front(rows, error)
    places = [place_of(row, error, up) for row in best]
    corners = places[:1]
    for (_, before), (x, y) in pairwise(places):
        corners += [(x, before), (x, y)]
    axes.plot(*zip(*corners, strict=True), color=INK, lw=1.3, zorder=2, solid_joinstyle="round")
    return corners


def _draw_point(axes: Axes, row: Row, error: str, up: Scale, looks: Looks) -> Bbox:
    """The marker of a setting; returns its box in pixels."""
    kind, color, at = kind_of(row), _color(row, looks), place_of(row, error, up)
    mark: dict[str, Any] = {"marker": "s", "ms": 10.0, "mfc": "none", "mew": 1.5, "zorder": 4.5}
    if kind == "own":
        mark = {"marker": "*", "ms": 17.0, "mec": "white", "mew": 0.8, "zorder": 5}
    elif kind == "single":
        mark = {**single_look(looks[row.setting.parts[0][0]]), "zorder": 4}
    elif kind == "pair":
        mark = {"marker": "d", "ms": 6.5, "mfc": "white", "mew": 1.0, "zorder": 4}
    axes.plot(*[[place] for place in at], ls="", color=color, clip_on=False, **mark)
    return boxed(axes, at, mark["ms"] / 2)


def _draw_interval(axes: Axes, row: Row, error: str, up: Scale, looks: Looks) -> list[Bbox]:
    """The interval of the error, thin; returns it in boxes of pixels."""
    figure = row.errors[error]
    ends = [(row.ms, up.place(shown(error, value))) for value in (figure.low, figure.high)]
    axes.plot(*zip(*ends, strict=True), color=_color(row, looks), lw=0.8, alpha=0.55, zorder=2.5)
    return pieces(axes, ends)


def _color(row: Row, looks: Looks) -> str:
    kind = kind_of(row)
    return COLORS[looks[row.setting.parts[0][0]]] if kind == "single" else PALE if kind == "pair" else "black"


def _legend(axes: Axes, looks: Looks) -> int:
    """Which marker is which knob, between heading and axes; returns how many lines that takes, at most two."""
    handles = [
        Line2D([], [], ls="", color=COLORS[look], label=cut(knob, LONGEST), **single_look(look))
        for knob, look in looks.items()
    ]
    columns = max(5, -(-len(looks) // 2))
    renderer, size = renderer_of(axes.figure), 9.0
    while True:
        legend = axes.legend(
            handles=handles,
            loc="lower left",
            bbox_to_anchor=(-0.02, 0.99),
            ncols=columns,
            frameon=False,
            fontsize=size,
            handletextpad=0.1,
            columnspacing=0.9,
            labelcolor=[TEXT_COLORS[look] for look in looks.values()],
        )
        if legend.get_window_extent(renderer).width <= axes.get_window_extent(renderer).width or size < 4.0:
            return -(-len(looks) // columns)
        size *= 0.95


def _labels(rows: Sequence[Row], panel: Panel, up: Scale, looks: Looks) -> list[Label]:
    """The job, presets and who halves the error first, then the front, then the rest from the cheapest on.

    What turns several knobs has a long name, and is named on the front alone.
    """
    error, labels = panel.error, []
    best = front(rows, error)
    for order, row in enumerate(sorted(rows, key=lambda row: row.ratio)):
        kind = kind_of(row)
        if kind == "pair" and row not in best:
            continue
        text, color, must, rank = row.setting.name, PALE if kind == "pair" else INK, True, 0.0
        if kind == "own":
            text = "the job"
        elif kind == "preset":
            text = row.setting.parts[0][1]
        elif kind == "single":
            text = row.setting.parts[0][1]
            color = TEXT_COLORS[looks[row.setting.parts[0][0]]]
        if kind in ("single", "pair") and row is not panel.half:
            must, rank = False, (1.0 if row in best else 2.0) + order * 1e-3
        labels.append(Label(cut(text, LONGEST), *place_of(row, error, up), color, rank, must))
    return labels
