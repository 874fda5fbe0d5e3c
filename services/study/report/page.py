"""A study as one HTML page that needs nothing beside it: no file, no script, no network."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from services.study.answer import answer
from services.study.choose import Targets, own_row
from services.study.errors import KINDS
from services.study.model import Study
from services.study.report.page_table import group_table
from services.study.words import duration, milliseconds, number, short, size

GROUPS = {
    "physics": "How objects rest",
    "labels": "Depth and masks",
    "mirror": "The other side",
    "colour": "Colour",
}

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #222; background: #fff; max-width: 1240px;
  margin: 2em auto; padding: 0 1.5em; }
h1 { font-size: 1.5em; margin-bottom: .3em; } h2 { font-size: 1.15em; margin: 2em 0 .4em; }
.answer { font-size: 1.2em; padding: .8em 1.1em; background: #eef5fa; border-left: 5px solid #0072B2; }
img { max-width: 100%; height: auto; } .knobs img { display: block; margin: 0 0 1.2em; max-height: 400px; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: .86em; font-variant-numeric: tabular-nums; }
th, td { padding: .22em .6em; text-align: right; white-space: nowrap; border-bottom: 1px solid #e8e8e8; vertical-align: top; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
thead th { border-bottom: 2px solid #888; vertical-align: bottom; font-weight: 600; white-space: normal; max-width: 8em; }
th.knob { padding-top: .9em; color: #666; font-weight: 600; text-align: left; }
tr.own td { background: #f4f4f4; font-weight: 600; } small { color: #777; font-weight: 400; display: block; }
td.better { background: #dcecf7; } td.worse { background: #fbe6d8; } td.front { font-weight: 700; }
.words td, .words th { white-space: normal; text-align: left; } code { background: #f4f4f4; padding: .1em .3em; }
summary { cursor: pointer; font-size: 1.15em; font-weight: 700; margin: 1.6em 0 .6em; }
"""

LEGEND = (
    "Each figure is the 95th percentile over scenes, or where it is of all scenes together one figure of them; small below "
    "it, its 95 % interval. Times are of processor on one core, as a multiple of the job's own in the same rounds, least to "
    "most below. Bold: no setting is cheaper and better. ▼ and blue: less than the job's by more than both intervals; "
    "▲ and orange: more. ≈: the order in time is noise. A dot: what is turned cannot move this error, which is as in the job, "
    "or it was not measured."
)


def write_page(study: Study, plots: Sequence[Path], file: Path, targets: Targets | None = None) -> None:
    """Write the page, with the pictures in it: the first of `plots` on top, the others where each knob is told of."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(page_of(study, plots, targets), encoding="utf-8")


def page_of(study: Study, plots: Sequence[Path], targets: Targets | None = None) -> str:
    """The whole of the page."""
    title = f"What accuracy costs in time: {escape(study.job)}"
    first, others = plots[:1], plots[1:]
    tables = (
        f"<h2>{name}</h2>{table}" for group, name in GROUPS.items() if (table := group_table(study, group))
    )  # fmt: skip
    parts = [
        f"<h1>{title}</h1>",
        f'<p class="answer">{escape(answer(study, targets))}</p>',
        *(_picture(plot, "Errors over processor time, a point for each setting") for plot in first),
        f"<p>{LEGEND}</p>",
        *tables,
        "<h2>What each error means, and what it is held against</h2>",
        _errors(study),
        _slopes(study),
        "<h2>What was not measured, and what to know</h2>",
        _notes(study),
        "<h2>Measured on</h2>",
        _machine(study),
        _knobs(others),
    ]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>'
    body = "\n".join(part for part in parts if part)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head><body>\n{body}\n</body></html>\n'


def _picture(plot: Path, what: str) -> str:
    data = base64.b64encode(plot.read_bytes()).decode("ascii")
    return f'<img alt="{escape(what)}" src="data:image/png;base64,{data}">'


def _knobs(plots: Sequence[Path]) -> str:
    if not plots:
        return ""
    pictures = "\n".join(
        _picture(plot, f"Errors over time along the knob {plot.stem.removeprefix('knob_')}") for plot in plots
    )
    return f'<details open class="knobs"><summary>Each knob by itself</summary>\n{pictures}\n</details>'


def _table(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Of cells that are escaped here."""
    cells = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    heads = "<thead><tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr></thead>" if head else ""
    return f'<div class="scroll"><table class="words">{heads}<tbody>{cells}</tbody></table></div>'


def _errors(study: Study) -> str:
    measured = {name for row in study.rows for name in row.errors}
    rows = [
        (kind.name, short(kind.name), kind.title, kind.unit or "0 to 1", kind.truth,
         "all scenes together" if kind.pooled else "95th percentile", "yes" if kind.name in measured else "no")
        for kind in KINDS
    ]  # fmt: skip
    return _table(rows, ("target", "in short", "what it says", "unit", "held against", "over scenes", "measured"))


def _slopes(study: Study) -> str:
    if not study.slopes:
        return ""
    rows = [(name, number(slope)) for name, slope in study.slopes.items()]
    return "<h2>How errors fall with the step on smooth cases</h2>" + _table(rows, ("case", "order in the step"))


def _notes(study: Study) -> str:
    """Of the study, then of its settings, each note once with whom it is about."""
    about: dict[str, list[str]] = {}
    for row in study.rows:
        for note in row.notes:
            about.setdefault(note, []).append(row.setting.name)
    lines = list(study.notes) + [f"{note} ({', '.join(names)})" for note, names in about.items()]
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines or ["Nothing was left out."]) + "</ul>"


def _machine(study: Study) -> str:
    own = own_row(study.rows)
    rows = [
        ("command", study.command),
        ("scenes", f"{study.scenes} made and {study.physics_scenes} dropped with each of {len(study.rows)} settings"),
        ("preset of the job", study.preset),
        ("a scene as the job is", f"{milliseconds(own.ms)} of processor, {size(own.kilobytes)}"),
    ]
    if study.job_scenes:
        seconds, kilobytes = own.ms * study.job_scenes / 1e3, own.kilobytes * study.job_scenes
        cost = f"{duration(seconds)} on one core ({number(seconds / 3600)} core-hours), {size(kilobytes)}"
        rows.append((f"the job's {study.job_scenes:,} scenes", cost))
    return _table(rows + [(name.replace("_", " "), _words(value)) for name, value in study.machine.items()])


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_words(inner)}" for name, inner in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_words, value))
    return number(value) if isinstance(value, float) else str(value)
