"""A picture for each knob: the errors that it moves, over processor time, from its coarsest value to its finest."""

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from matplotlib.transforms import Bbox

from services.study.choose import own_row
from services.study.model import Row, Study
from services.study.report.labels import Label, place_labels
from services.study.report.panel import LONGEST, MOVED
from services.study.report.pictures import (
    COLORS,
    DOTS,
    INK,
    TEXT_COLORS,
    boxed,
    cut,
    fit,
    new_picture,
    pieces,
    place_of,
    renderer_of,
    set_axes,
    up_scale,
)
from services.study.report.scales import Scale, scale_of
from services.study.words import as_often, shown

MOST_ERRORS = 3
"""A picture shows the errors that move most."""

SIDE, HEIGHT = 4.0, 3.7
"""Inches."""


def single_knobs(rows: Sequence[Row]) -> list[str]:
    """Knobs that were turned by themselves, in the order of the table."""
    turned = (row.setting.parts[0][0] for row in rows if len(row.setting.parts) == 1)
    return [knob for knob in dict.fromkeys(turned) if knob != "preset"]


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
    picture = new_picture(SIDE * max(len(errors), 2), HEIGHT)
    wide, high = picture.get_size_inches()
    turned = knob_rows(study.rows, knob)
    least, most = (as_often(pick(row.ratio for row in turned)) for pick in (min, max))
    title = f"{knob}: {_span(least, most)} × the job's time"
    head = picture.text(0.15 / wide, 1 - 0.15 / high, title, fontsize=13, fontweight="bold", color=INK, va="top")
    fit(head, (wide - 0.3) * DOTS)
    for number, error in enumerate(errors):
        left = number * wide / len(errors) + 0.95
        box = (left / wide, 0.55 / high, (wide / len(errors) - 1.1) / wide, (HEIGHT - 1.15) / high)
        _draw_along(picture.add_axes(box), study, [row for row in turned if error in row.errors], error)
    return picture


def _span(least: str, most: str) -> str:
    return least if least == most else f"{least} to {most}"


def _draw_along(axes: Axes, study: Study, turned: Sequence[Row], error: str) -> None:
    """The knob's values as they follow one another, each with both its intervals, and the job as a star."""
    own = own_row(study.rows)
    rows = [*turned, own] if error in own.errors else list(turned)
    up, ratios = (
        up_scale(rows, error),
        [ratio for row in rows for ratio in (row.ratio_least, row.ratio, row.ratio_most)],
    )
    set_axes(axes, scale_of([ratio * own.ms for ratio in ratios]), up, error)
    places = [place_of(row, error, up) for row in turned]
    axes.plot(*zip(*places, strict=True), color=COLORS[0], lw=1.2, alpha=0.45, zorder=2)
    marks, labels, lines = [], [], pieces(axes, places)
    for order, row in enumerate(rows):
        is_own = row is own
        marks.append(_draw_mark(axes, place_of(row, error, up), is_own))
        lines += _draw_intervals(axes, row, error, up, own.ms)
        text, color = ("the job", INK) if is_own else (row.setting.parts[0][1], TEXT_COLORS[0])
        labels.append(
            Label(cut(text, LONGEST), *place_of(row, error, up), color, 0.0 if is_own else order + 1.0, must=is_own)
        )
    place_labels(axes, renderer_of(axes.figure), labels, marks, lines)


def _draw_mark(axes: Axes, at: tuple[float, float], is_own: bool) -> Bbox:
    """The marker, whose box in pixels is returned."""
    color, marker, size = ("black", "*", 15.0) if is_own else (COLORS[0], "o", 6.0)
    axes.plot(
        *[[place] for place in at],
        ls="",
        marker=marker,
        ms=size,
        color=color,
        mec="white",
        mew=0.7,
        zorder=4,
        clip_on=False,
    )
    return boxed(axes, at, size / 2)


def _draw_intervals(axes: Axes, row: Row, error: str, up: Scale, own_ms: float) -> list[Bbox]:
    """Of error and time, thin; returned in boxes of pixels."""
    (x, y), figure = place_of(row, error, up), row.errors[error]
    low, high = (up.place(shown(error, value)) for value in (figure.low, figure.high))
    boxes = []
    for ends in ([(x, low), (x, high)], [(row.ratio_least * own_ms, y), (row.ratio_most * own_ms, y)]):
        axes.plot(*zip(*ends, strict=True), color=COLORS[0] if row.setting.parts else "black", lw=0.9, alpha=0.6)
        boxes += pieces(axes, ends)
    return boxes
