"""Pictures of a study: what accuracy costs in time, all in one, and each knob by itself."""

from pathlib import Path

from matplotlib.figure import Figure as Picture
from matplotlib.lines import Line2D

from services.study.choose import own_row
from services.study.model import Study
from services.study.report.knob_plots import draw_knob, single_knobs
from services.study.report.panel import Panel, draw_panel, looks_of, panels_of
from services.study.report.pictures import DOTS, INK, PALE, cut, fit, new_picture, plain_style
from services.study.words import cost, milliseconds

WIDTH = 12.0

TRADEOFF_FILE = "tradeoff.png"

HEAD, ABOVE, AXES, BELOW, FOOT = 0.75, 0.7, 3.25, 0.6, 0.3
"""Heights in inches: of the title, above each axes, of it, below it, and of the legend."""

LEFT, RIGHT = 0.75, 0.15

TRADEOFF_FILE = "tradeoff.png"


def write_plots(study: Study, folder: Path) -> list[Path]:
    """Write tradeoff.png and knob_NAME.png for each knob; returns their paths, tradeoff.png first."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with plain_style():
        pictures = {TRADEOFF_FILE: draw_tradeoff(study)}
        for knob in single_knobs(study.rows):
            drawn = draw_knob(study, knob)
            if drawn is not None:
                pictures[knob_file(knob)] = drawn
        for name, picture in pictures.items():
            # Neither a date nor the library's name, so that the same study gives the same bytes.
            picture.savefig(folder / name, dpi=DOTS, metadata={"Software": None})
            written.append(folder / name)
    return written


def knob_file(knob: str) -> str:
    """The name of a knob's picture."""
    return f"knob_{''.join(letter if letter.isalnum() else '_' for letter in knob)}.png"


def draw_tradeoff(study: Study) -> Picture:
    """A panel for each part of a scene: its main error over processor time, both logarithmic."""
    panels = panels_of(study.rows)
    columns = 1 if len(panels) == 1 else 2
    height = HEAD + -(-len(panels) // columns) * (ABOVE + AXES + BELOW) + FOOT
    picture, looks = new_picture(WIDTH, height), looks_of(study.rows, panels)
    _head(picture, study, panels)
    for number, panel in enumerate(panels):
        line, column = divmod(number, columns)
        left = LEFT + column * WIDTH / 2
        bottom = height - HEAD - (line + 1) * (ABOVE + AXES + BELOW) + BELOW
        wide = WIDTH / columns - LEFT - RIGHT
        box = (left / WIDTH, bottom / height, wide / WIDTH, AXES / height)
        draw_panel(picture.add_axes(box), study, panel, looks[panel.error])
    _foot(picture)
    return picture


def _head(picture: Picture, study: Study, panels: list[Panel]) -> None:
    """The message in one line, and below it what was measured on what."""
    top = 1 - 0.15 / picture.get_figheight()
    title = picture.text(0.015, top, headline(study, panels), fontsize=15, fontweight="bold", color=INK, va="top")
    fit(title, 0.965 * WIDTH * DOTS)
    measured = (
        f"{cut(study.job, 40)}: {study.scenes} scenes made and {study.physics_scenes} dropped with each of {len(study.rows)}"
        f" settings; one core of {cut(str(study.machine.get('cpu', 'an unknown processor')), 60)}"
    )
    below = 1 - 0.5 / picture.get_figheight()
    fit(picture.text(0.015, below, measured, fontsize=10, color=PALE, va="top"), 0.965 * WIDTH * DOTS)


def headline(study: Study, panels: list[Panel]) -> str:
    """What half of each error costs, in one line."""
    costs = [f"{cost(half.ratio)} {panel.name}" for panel in panels if (half := panel.half) is not None]
    scene = f"A scene takes {milliseconds(own_row(study.rows).ms)}"
    if not costs:
        return f"{scene}; no setting that was measured halves an error"
    return f"{scene}; half the error takes {', '.join(costs)}"


def _foot(picture: Picture) -> None:
    """What the marks mean."""
    kinds = [
        Line2D([], [], ls="", marker="*", ms=15, color="black", label="the job as it is"),
        Line2D([], [], ls="", marker="o", ms=6, color=PALE, label="one knob turned, named by its value"),
        Line2D([], [], ls="", marker="d", ms=6, color=PALE, mfc="white", label="several at once"),
        Line2D([], [], ls="", marker="s", ms=10, color="black", mfc="none", mew=1.5, label="preset"),
        Line2D([], [], color=INK, lw=1.3, label="front: nothing is cheaper and better"),
        Line2D([0], [0], color=PALE, lw=0.8, label="95 % interval over scenes"),
    ]
    picture.legend(
        handles=kinds, loc="lower center", ncols=6, frameon=False, fontsize=9.5, handletextpad=0.4, columnspacing=1.4
    )
