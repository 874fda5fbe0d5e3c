"""A study as one HTML page that needs nothing beside it: no file, no script, no network."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from services.study.answer import answer
from services.study.choose import Targets, own_row
from services.study.errors import ERRORS
from services.study.model import Study
from services.study.report.page_table import group_table
from services.study.words import duration, milliseconds, number, short, size

TEMPLATE = Path(__file__).with_name("page.html")

GROUPS = {
    "physics": "How objects rest",
    "labels": "Depth and masks",
    "mirror": "The other side",
    "colour": "Colour",
}


def write_page(study: Study, plots: Sequence[Path], file: Path, targets: Targets | None = None) -> None:
    """Write the page with the pictures in it: the first of `plots` on top, the others at the end, one for each knob."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(page_of(study, plots, targets), encoding="utf-8")


def page_of(study: Study, plots: Sequence[Path], targets: Targets | None = None) -> str:
    """The whole page."""
    tables = {name: group_table(study, group) for group, name in GROUPS.items()}
    knobs = [_picture(plot, f"Errors over time along the knob {plot.stem.removeprefix('knob_')}") for plot in plots[1:]]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        job=escape(study.job),
        answer=escape(answer(study, targets)),
        tradeoff="".join(_picture(plot, "Errors over processor time, a point for each setting") for plot in plots[:1]),
        groups="\n".join(f"<h2>{name}</h2>{table}" for name, table in tables.items() if table),
        errors=_errors(study),
        slopes=_slopes(study),
        notes="".join(f"<li>{escape(line)}</li>" for line in _notes(study) or ["Nothing was left out."]),
        machine=_machine(study),
        knobs=f'<details open class="knobs"><summary>Each knob by itself</summary>\n{"".join(knobs)}</details>'
        if knobs
        else "",
    )


def _picture(plot: Path, what: str) -> str:
    data = base64.b64encode(plot.read_bytes()).decode("ascii")
    return f'<img alt="{escape(what)}" src="data:image/png;base64,{data}">\n'


def _table(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of cells that are escaped here."""
    cells = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    heads = "<thead><tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr></thead>" if head else ""
    return f'<div class="scroll"><table class="words">{heads}<tbody>{cells}</tbody></table></div>'


def _errors(study: Study) -> str:
    measured = {name for row in study.rows for name in row.errors}
    rows = [
        (kind.name, short(kind.name), kind.title, kind.unit or "0 to 1", kind.truth,
         "all scenes together" if kind.pooled else "95th percentile", "yes" if kind.name in measured else "no")
        for kind in ERRORS.values()
    ]  # fmt: skip
    return _table(rows, ("target", "in short", "what it says", "unit", "held against", "over scenes", "measured"))


def _slopes(study: Study) -> str:
    if not study.slopes:
        return ""
    rows = [(name, number(slope)) for name, slope in study.slopes.items()]
    return "<h2>How errors fall with the step on smooth cases</h2>" + _table(rows, ("case", "order in the step"))


def _notes(study: Study) -> list[str]:
    """The study's notes, then its settings' notes, each once with the names of its settings."""
    about: dict[str, list[str]] = {}
    for row in study.rows:
        for note in row.notes:
            about.setdefault(note, []).append(row.setting.name)
    return [*study.notes, *(f"{note} ({', '.join(names)})" for note, names in about.items())]


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
