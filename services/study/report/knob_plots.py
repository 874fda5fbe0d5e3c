"""A plot for each knob: the errors that it moves over processor time, from its coarsest value to its finest."""

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from services.study.choose import own_row
from services.study.model import Row, Study
from services.study.report.axes import (
    COLORS,
    INK,
    TEXT_COLORS,
    cut,
    draw_row,
    new_picture,
    place_of,
    set_axes,
    write_head,
)
from services.study.report.labels import Label, place_labels
from services.study.report.panel import MOVED, OWN_MARK, knob_mark
from services.study.words import as_often

MOST_ERRORS = 3
"""The most errors that a plot shows: those that move most."""

SIDE, HEIGHT, HEAD = 4.0, 3.7, 0.55
"""Inches."""


def single_knobs(rows: Sequence[Row]) -> list[str]:
    """Knobs that were turned by themselves, in the order of the table."""
    return list(dict.fromkeys(row.setting.parts[0][0] for row in rows if row.setting.kind == "single"))


def knob_rows(rows: Sequence[Row], knob: str) -> list[Row]:
    """The settings that turn this knob alone, in the order of the table: from coarse to fine."""
    return [row for row in rows if len(row.setting.parts) == 1 and row.setting.parts[0][0] == knob]


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
    columns = max(len(errors), 2)
    picture = new_picture(SIDE * columns, HEIGHT, HEAD)
    turned = knob_rows(study.rows, knob)
    ends = dict.fromkeys(as_often(pick(row.ratio for row in turned)) for pick in (min, max))
    title = f"{knob}: {' to '.join(ends)} × the job's time"
    write_head(picture, title, 0.15, fontsize=13, fontweight="bold", color=INK)
    labels = {}
    for number, error in enumerate(errors):
        axes = picture.add_subplot(1, columns, number + 1)
        labels[axes] = _draw_along(axes, study, [row for row in turned if error in row.errors], error)
    picture.draw_without_rendering()
    picture.set_layout_engine("none")
    for axes, some in labels.items():
        place_labels(axes, some)
    return picture


def _draw_along(axes: Axes, study: Study, turned: Sequence[Row], error: str) -> list[Label]:
    """The knob's values joined in their order, with intervals of error and time, and the job as a star; their labels."""
    own = own_row(study.rows)
    rows = [*turned, own] if error in own.errors else list(turned)
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
