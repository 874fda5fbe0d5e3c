"""The plots of a study: what accuracy costs in time, and each knob by itself.

- One panel: an error over processor time, a point for each setting that was measured.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.cbook import pts_to_poststep
from matplotlib.figure import Figure as Picture
from matplotlib.lines import Line2D

from services.study.choose import front, own_row
from services.study.model import Row, Study
from services.study.report.axes import (
    COLORS,
    DOTS,
    INK,
    MARKERS,
    PALE,
    TEXT_COLORS,
    Label,
    cut,
    draw_row,
    new_picture,
    place_labels,
    place_of,
    plain_style,
    renderer_of,
    set_axes,
    write_head,
)
from services.study.words import as_often, cost, milliseconds

_PHYSICS = (
    "pose_mm",
    "moved_mm",
    "outcome_mm",
    "penetration_mm",
    "gap_mm",
    "unbalanced_share",
    "turned_deg",
    "outcome_deg",
)

_MAIN = (
    ("at rest", "How objects rest", _PHYSICS),
    ("in depth", "Depth and masks", ("between_mm", "depth_mm", "outline_share", "mask_share", "table_depth_mm")),
    ("in the mirror", "The other side", ("mirror_mm", "agreement_mm", "unfilled_share", "hidden_share")),
    ("in colour", "Colour", ("flip", "edge_flip")),
    ("in the poses", "Camera poses", ("camera_mm", "camera_deg")),
    ("in the cloud", "Merged cloud", ("cloud_mm", "cloud_p95_mm")),
    ("in completeness", "What is missing", ("missing_share",)),
    ("in new views", "Synthesised views", ("view_depth_mm",)),
)
"""Each part of a scene: its name in the title, its heading, and its errors. The panel shows the first that settings move."""

MOVED = 0.05
"""A knob that moves an error by no more than this share of the job's own is left out of its panel."""

Mark = Mapping[str, Any]
"""Properties of a marker."""

Looks = Mapping[str, int]
"""The number of a knob's colour and marker."""


@dataclass(frozen=True)
class Panel:
    """What a panel shows: an error, and the cheapest setting with at most half of the job's own, if any."""

    name: str
    heading: str
    error: str
    half: Row | None


def panels_of(rows: Sequence[Row]) -> list[Panel]:
    """One for each part of a scene in which a setting moved an error; where there is none, those of the job alone."""
    moved_panels: list[Panel] = []
    own_panels: list[Panel] = []
    for name, heading, errors in _MAIN:
        measured = [error for error in errors if any(error in row.errors for row in rows)]
        moved = [error for error in measured if len(moving_rows(rows, error)) > 1]
        for error in (moved or measured)[:1]:
            (moved_panels if moved else own_panels).append(Panel(name, heading, error, half_row(rows, error)))
    return moved_panels or own_panels


def moving_rows(rows: Sequence[Row], error: str) -> list[Row]:
    """The settings that a panel shows.

    The job, presets, knobs of which a value moves the error by more than `MOVED`, and combinations with such a knob.
    """
    measured = [row for row in rows if error in row.errors]
    own = own_row(rows).errors.get(error)
    moving = {
        row.setting.knob
        for row in measured
        if row.setting.kind == "single"
        and (own is None or abs(row.errors[error].value - own.value) > MOVED * own.value)
    }
    return [row for row in measured if row.setting.kind in ("own", "preset") or set(dict(row.setting.parts)) & moving]


def half_row(rows: Sequence[Row], error: str) -> Row | None:
    """The cheapest setting that measured at most half of the job's own error."""
    own = own_row(rows).errors.get(error)
    if own is None or own.value <= 0.0:
        return None
    return next((row for row in front(rows, error) if row.errors[error].value <= own.value / 2), None)


def looks_of(rows: Sequence[Row], panels: Sequence[Panel]) -> dict[str, Looks]:
    """Looks by the panel's error: a knob has the same in all panels, and as far as they go no other knob of a panel has it."""
    turned = {}
    for panel in panels:
        single = [row.setting for row in moving_rows(rows, panel.error) if row.setting.kind == "single"]
        turned[panel.error] = list(dict.fromkeys(setting.knob for setting in single))
    often = Counter(knob for knobs in turned.values() for knob in knobs)
    everywhere: dict[str, int] = {}
    for knob in sorted(often, key=lambda knob: -often[knob]):  # knobs of several panels choose first
        beside = {other for knobs in turned.values() if knob in knobs for other in knobs}
        used = Counter(everywhere[other] for other in beside if other in everywhere)
        everywhere[knob] = min(range(len(COLORS)), key=lambda look: (used[look], look))
    return {error: {knob: everywhere[knob] for knob in knobs} for error, knobs in turned.items()}


def draw_panel(axes: Axes, study: Study, panel: Panel, looks: Looks, width: float) -> list[Label]:
    """Points, intervals, front, and a heading with its message; `width` in inches. Returns the labels to place."""
    rows, error = moving_rows(study.rows, panel.error), panel.error
    best = front(rows, error)
    set_axes(axes, [row.ms for row in rows], rows, error)
    corners = pts_to_poststep(*zip(*(place_of(row, error) for row in best), strict=True))
    axes.plot(*corners, color=INK, lw=1.3, zorder=2, solid_joinstyle="round")
    marks = {"own": OWN_MARK, "preset": PRESET_MARK, "several": SEVERAL_MARK}
    for row in rows:
        draw_row(axes, row, error, **(marks.get(row.setting.kind) or knob_mark(looks[row.setting.knob])))
    lines = _draw_legend(axes, looks, width)
    place: dict[str, Any] = {"fontsize": 12, "fontweight": "bold", "color": INK, "pad": 8.0 + 14.0 * lines}
    title = axes.set_title(panel.heading, loc="left", **place)
    beside: dict[str, Any] = {"xycoords": title, "textcoords": "offset points", "va": "bottom"}
    axes.annotate(_message(study.rows, panel), (1.0, 0.0), (8.0, 0.0), fontsize=11, color=INK, **beside)
    return _labels(rows, panel, best, looks)


def _message(rows: Sequence[Row], panel: Panel) -> str:
    """What a smaller error costs."""
    best = front(rows, panel.error)[-1]
    if panel.half is not None:
        return f"half the error takes {cost(panel.half.ratio)}"
    own = own_row(rows).errors.get(panel.error)
    if own is None or own.value <= best.errors[panel.error].value:
        return "nothing better was measured"
    less = 1.0 - best.errors[panel.error].value / own.value
    return f"{100 * less:.2g} % less error takes {cost(best.ratio)}"


def knob_mark(look: int) -> Mark:
    """Colour and marker of a knob; the pale colour has an edge that is seen on white."""
    edge = TEXT_COLORS[look] if COLORS[look] == "#F0E442" else "white"
    size = 7.0 if MARKERS[look] in "PX" else 6.0
    return {"color": COLORS[look], "marker": MARKERS[look], "ms": size, "mec": edge, "mew": 0.6, "zorder": 4}


OWN_MARK: Mark = {"color": "black", "marker": "*", "ms": 17.0, "mec": "white", "mew": 0.8, "zorder": 5}
PRESET_MARK: Mark = {"color": "black", "marker": "s", "ms": 10.0, "mfc": "none", "mew": 1.5, "zorder": 4.5}
SEVERAL_MARK: Mark = {"color": PALE, "marker": "d", "ms": 6.5, "mfc": "white", "mew": 1.0, "zorder": 4}


def _draw_legend(axes: Axes, looks: Looks, width: float) -> int:
    """Which marker is which knob, between heading and axes; returns its number of lines, at most two."""
    handles = [Line2D([], [], ls="", label=cut(knob), **knob_mark(look)) for knob, look in looks.items()]
    columns = max(5, -(-len(looks) // 2))
    style: dict[str, Any] = {"frameon": False, "handletextpad": 0.1, "columnspacing": 0.9, "ncols": columns}
    style |= {
        "loc": "lower left",
        "bbox_to_anchor": (-0.02, 0.99),
        "labelcolor": [TEXT_COLORS[n] for n in looks.values()],
    }
    for size in (9.0, 8.0, 7.0, 6.0, 5.0, 4.0):
        legend = axes.legend(handles=handles, fontsize=size, **style)
        if legend.get_window_extent(renderer_of(axes.figure)).width <= width * DOTS:
            break
    return -(-len(looks) // columns)


def _labels(rows: Sequence[Row], panel: Panel, best: Sequence[Row], looks: Looks) -> list[Label]:
    """The job, presets and the half first, then the front, then the rest from the cheapest on.

    A combination has a long name, and is named on the front alone.
    """
    labels = []
    named = [row for row in rows if row.setting.kind != "several" or row in best]
    for order, row in enumerate(sorted(named, key=lambda row: row.ratio)):
        kind = row.setting.kind
        must = kind in ("own", "preset") or row is panel.half
        text = row.setting.parts[0][1] if kind in ("preset", "single") else row.setting.name
        color = TEXT_COLORS[looks[row.setting.knob]] if kind == "single" else PALE if kind == "several" else INK
        rank = 0.0 if must else (1.0 if row in best else 2.0) + order * 1e-3
        labels.append(Label(cut(text), place_of(row, panel.error), color, rank, must))
    return labels


TRADEOFF_FILE = "tradeoff.png"

WIDTH, PANEL, HEAD, FOOT = 12.0, 4.5, 0.8, 0.35
"""Inches: the picture's width, and the heights of a panel, the title and the legend."""

KNOB_WIDTH, KNOB_HEIGHT, KNOB_HEAD = 4.0, 3.7, 0.55
"""Inches: a panel of a knob's picture, and its title."""

MOST_ERRORS = 3
"""The most errors that a knob's picture shows: those that move most."""


def write_plots(study: Study, folder: Path) -> list[Path]:
    """Write tradeoff.png and knob_NAME.png for each knob; returns their paths, tradeoff.png first."""
    folder.mkdir(parents=True, exist_ok=True)
    with plain_style():
        pictures: dict[Path, Picture | None] = {folder / TRADEOFF_FILE: draw_tradeoff(study)}
        for knob in single_knobs(study.rows):
            name = "".join(letter if letter.isalnum() else "_" for letter in knob)
            pictures[folder / f"knob_{name}.png"] = draw_knob(study, knob)
        drawn = {path: picture for path, picture in pictures.items() if picture is not None}
        for path, picture in drawn.items():
            # Neither a date nor the library's name, so that the same study gives the same bytes.
            picture.savefig(path, dpi=DOTS, metadata={"Software": None})
    return list(drawn)


def draw_tradeoff(study: Study) -> Picture:
    """A panel for each part of a scene: its main error over processor time, both logarithmic."""
    panels = panels_of(study.rows)
    columns = 1 if len(panels) == 1 else 2
    lines = -(-len(panels) // columns)
    picture, looks = new_picture(WIDTH, HEAD + lines * PANEL + FOOT, HEAD, FOOT), looks_of(study.rows, panels)
    write_head(picture, headline(study, panels), 0.15, fontsize=15, fontweight="bold", color=INK)
    core = cut(str(study.machine.get("cpu", "an unknown processor")), 60)
    measured = f"{cut(study.job, 40)}: {study.sample} with each of {len(study.rows)} settings; one core of {core}"
    write_head(picture, measured, 0.5, fontsize=10, color=PALE)
    _draw_foot(picture)

    def draw(axes: Axes, number: int) -> list[Label]:
        panel = panels[number]
        return draw_panel(axes, study, panel, looks[panel.error], WIDTH / columns - 1.0)

    _draw_panels(picture, (lines, columns), len(panels), draw)
    return picture


def _draw_panels(picture: Picture, grid: tuple[int, int], count: int, draw: Callable[[Axes, int], list[Label]]) -> None:
    """Lay out the panels, then place the labels that `draw` returns for each axes and number."""
    labels = {}
    for number in range(count):
        axes = picture.add_subplot(*grid, number + 1)
        labels[axes] = draw(axes, number)
    picture.draw_without_rendering()
    picture.set_layout_engine("none")
    for axes, some in labels.items():
        place_labels(axes, some)


def headline(study: Study, panels: list[Panel]) -> str:
    """What half of each error costs, in one line."""
    costs = [f"{cost(half.ratio)} {panel.name}" for panel in panels if (half := panel.half) is not None]
    scene = f"A scene takes {milliseconds(own_row(study.rows).ms)}"
    if not costs:
        return f"{scene}; no setting that was measured halves an error"
    return f"{scene}; half the error takes {', '.join(costs)}"


def _draw_foot(picture: Picture) -> None:
    """What the marks mean."""
    marks = {
        "the job as it is": OWN_MARK,
        "one knob turned, named by its value": {"color": PALE, "marker": "o", "ms": 6},
        "several at once": SEVERAL_MARK,
        "preset": PRESET_MARK,
        "front: nothing is cheaper and better": {"color": INK, "ls": "-", "lw": 1.3},
        "95 % interval over scenes": {"color": PALE, "ls": "-", "lw": 0.8},
    }
    kinds = [Line2D([], [], label=label, **{"ls": "", **mark}) for label, mark in marks.items()]
    style: dict[str, Any] = {"fontsize": 9.5, "frameon": False, "handletextpad": 0.4, "columnspacing": 1.4}
    picture.legend(handles=kinds, loc="lower center", ncols=6, **style)


# ---------------------------------------------------------------------------------------------- each knob by itself


def single_knobs(rows: Sequence[Row]) -> list[str]:
    """Knobs that were turned by themselves, in the order of the table."""
    return list(dict.fromkeys(row.setting.knob for row in rows if row.setting.kind == "single"))


def knob_rows(rows: Sequence[Row], knob: str) -> list[Row]:
    """The settings that turn this knob alone, in the order of the table: from coarse to fine."""
    return [row for row in rows if len(row.setting.parts) == 1 and row.setting.knob == knob]


def moved_errors(rows: Sequence[Row], knob: str) -> list[str]:
    """The errors that a knob was seen to move, the one that moves farthest first."""
    turned, own = knob_rows(rows, knob), own_row(rows)
    spread = {}
    for name in dict.fromkeys(name for row in turned for name in row.errors):
        values = [row.errors[name].value for row in [own, *turned] if name in row.errors]
        if max(values) > min(values) * (1 + MOVED):
            spread[name] = math.inf if min(values) <= 0 else max(values) / min(values)
    return sorted(spread, key=lambda name: -spread[name])


def draw_knob(study: Study, knob: str) -> Picture | None:
    """One panel for each of its main errors, or None where it moved nothing that was measured."""
    errors = moved_errors(study.rows, knob)[:MOST_ERRORS]
    if not errors:
        return None
    columns, turned = max(len(errors), 2), knob_rows(study.rows, knob)
    picture = new_picture(KNOB_WIDTH * columns, KNOB_HEIGHT, KNOB_HEAD)
    ends = dict.fromkeys(as_often(pick(row.ratio for row in turned)) for pick in (min, max))
    title = f"{knob}: {' to '.join(ends)} × the job's time"
    write_head(picture, title, 0.15, fontsize=13, fontweight="bold", color=INK)
    _draw_panels(picture, (1, columns), len(errors), lambda axes, n: _draw_along(axes, study, turned, errors[n]))
    return picture


def _draw_along(axes: Axes, study: Study, turned: Sequence[Row], error: str) -> list[Label]:
    """The knob's values joined in their order, with intervals of error and time, and the job as a star; their labels."""
    own, turned = own_row(study.rows), [row for row in turned if error in row.errors]
    rows = [*turned, own] if error in own.errors else turned
    ratios = [ratio for row in rows for ratio in (row.ratio_least, row.ratio, row.ratio_most)]
    set_axes(axes, [ratio * own.ms for ratio in ratios], rows, error)
    places = [place_of(row, error) for row in turned]
    axes.plot(*zip(*places, strict=True), color=COLORS[0], lw=1.2, alpha=0.45, zorder=2)
    for row in rows:
        draw_row(axes, row, error, own_ms=own.ms, **(OWN_MARK if row is own else knob_mark(0)))
    labels = [
        Label(cut(row.setting.parts[0][1]), place, TEXT_COLORS[0], order + 1.0)
        for order, (row, place) in enumerate(zip(turned, places, strict=True))
    ]
    return labels + ([Label("the job", place_of(own, error), INK, 0.0, must=True)] if own in rows else [])
