"""One panel: an error over processor time, a point for each setting that was measured."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.cbook import pts_to_poststep
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
    cut,
    draw_row,
    place_of,
    renderer_of,
    set_axes,
)
from services.study.report.labels import Label
from services.study.words import cost

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
