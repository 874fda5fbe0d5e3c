"""All plots of a study: what accuracy costs in time, and each knob by itself."""

from pathlib import Path

from matplotlib.figure import Figure as Picture
from matplotlib.lines import Line2D

from services.study.choose import own_row
from services.study.model import Study
from services.study.report.axes import DOTS, INK, PALE, cut, new_picture, plain_style, write_head
from services.study.report.knob_plots import draw_knob, single_knobs
from services.study.report.labels import place_labels
from services.study.report.panel import (
    OWN_MARK,
    PRESET_MARK,
    SEVERAL_MARK,
    Mark,
    Panel,
    draw_panel,
    looks_of,
    panels_of,
)
from services.study.words import cost, milliseconds

TRADEOFF_FILE = "tradeoff.png"

WIDTH, PANEL, HEAD, FOOT = 12.0, 4.5, 0.8, 0.35
"""Inches: the picture's width, and the heights of a panel, the title and the legend."""


def write_plots(study: Study, folder: Path) -> list[Path]:
    """Write tradeoff.png and knob_NAME.png for each knob; returns their paths, tradeoff.png first."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with plain_style():
        pictures = {folder / TRADEOFF_FILE: draw_tradeoff(study)}
        for knob in single_knobs(study.rows):
            drawn = draw_knob(study, knob)
            if drawn is not None:
                pictures[folder / knob_file(knob)] = drawn
        for path, picture in pictures.items():
            # Neither a date nor the library's name, so that the same study gives the same bytes.
            picture.savefig(path, dpi=DOTS, metadata={"Software": None})
            written.append(path)
    return written


def knob_file(knob: str) -> str:
    """The file name of a knob's plot."""
    return f"knob_{''.join(letter if letter.isalnum() else '_' for letter in knob)}.png"


def draw_tradeoff(study: Study) -> Picture:
    """A panel for each part of a scene: its main error over processor time, both logarithmic."""
    panels = panels_of(study.rows)
    columns = 1 if len(panels) == 1 else 2
    lines = -(-len(panels) // columns)
    picture, looks = new_picture(WIDTH, HEAD + lines * PANEL + FOOT, HEAD, FOOT), looks_of(study.rows, panels)
    write_head(picture, headline(study, panels), 0.15, fontsize=15, fontweight="bold", color=INK)
    measured = (
        f"{cut(study.job, 40)}: {study.scenes} scenes made and {study.physics_scenes} dropped with each of {len(study.rows)}"
        f" settings; one core of {cut(str(study.machine.get('cpu', 'an unknown processor')), 60)}"
    )
    write_head(picture, measured, 0.5, fontsize=10, color=PALE)
    labels = {}
    for number, panel in enumerate(panels):
        axes = picture.add_subplot(lines, columns, number + 1)
        labels[axes] = draw_panel(axes, study, panel, looks[panel.error], WIDTH / columns - 1.0)
    _draw_foot(picture)
    picture.draw_without_rendering()
    picture.set_layout_engine("none")
    for axes, some in labels.items():
        place_labels(axes, some)
    return picture


def headline(study: Study, panels: list[Panel]) -> str:
    """What half of each error costs, in one line."""
    costs = [f"{cost(half.ratio)} {panel.name}" for panel in panels if (half := panel.half) is not None]
    scene = f"A scene takes {milliseconds(own_row(study.rows).ms)}"
    if not costs:
        return f"{scene}; no setting that was measured halves an error"
    return f"{scene}; half the error takes {', '.join(costs)}"


def _draw_foot(picture: Picture) -> None:
    """What the marks mean."""
    knob: Mark = {"color": PALE, "marker": "o", "ms": 6}
    marks = (
        (OWN_MARK, "the job as it is"),
        (knob, "one knob turned, named by its value"),
        (SEVERAL_MARK, "several at once"),
    )
    kinds = [Line2D([], [], ls="", label=label, **mark) for mark, label in (*marks, (PRESET_MARK, "preset"))]
    kinds.append(Line2D([], [], color=INK, lw=1.3, label="front: nothing is cheaper and better"))
    kinds.append(Line2D([], [], color=PALE, lw=0.8, label="95 % interval over scenes"))
    picture.legend(
        handles=kinds, loc="lower center", ncols=6, frameon=False, fontsize=9.5, handletextpad=0.4, columnspacing=1.4
    )
