"""All plots of a study: what accuracy costs in time, and each knob by itself."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from matplotlib.lines import Line2D

from services.study.choose import own_row
from services.study.model import Row, Study
from services.study.report.axes import (
    COLORS,
    DOTS,
    INK,
    PALE,
    TEXT_COLORS,
    cut,
    draw_row,
    new_picture,
    place_of,
    plain_style,
    set_axes,
    write_head,
)
from services.study.report.labels import Label, place_labels
from services.study.report.panel import (
    MOVED,
    OWN_MARK,
    PRESET_MARK,
    SEVERAL_MARK,
    Panel,
    draw_panel,
    knob_mark,
    looks_of,
    panels_of,
)
from services.study.words import as_often, cost, milliseconds

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
