"""A study as one HTML page that needs nothing beside it: no file, no script, no network."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from schemas.errors import describe_seconds
from services.study.answer import answer
from services.study.choose import Targets, as_cheap, front, own_row
from services.study.errors import ERRORS
from services.study.model import Row, Study
from services.study.words import milliseconds, number, short, shown, size, times, unit

TEMPLATE = Path(__file__).with_name("page.html")

GROUPS = {
    "physics": "How objects rest",
    "labels": "Depth and masks",
    "mirror": "The other side",
    "colour": "Colour",
    "capture": "Captures",
}


def write_page(study: Study, plots: Sequence[Path], file: Path, targets: Targets | None = None) -> None:
    """Write the page with the pictures in it: the first of `plots` on top, the others at the end, one for each knob."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(page_of(study, plots, targets), encoding="utf-8")


def page_of(study: Study, plots: Sequence[Path], targets: Targets | None = None) -> str:
    """The whole page."""
    tables = {name: _group_table(study, group) for group, name in GROUPS.items()}
    knobs = [_picture(plot, f"Errors over time along the knob {plot.stem.removeprefix('knob_')}") for plot in plots[1:]]
    summary = '<details open class="knobs"><summary>Each knob by itself</summary>'
    slopes = _table([(name, number(order)) for name, order in study.slopes.items()], ("case", "order in the step"))
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        job=escape(study.job),
        answer=escape(answer(study, targets)),
        tradeoff="".join(_picture(plot, "Errors over processor time, a point for each setting") for plot in plots[:1]),
        groups="\n".join(f"<h2>{name}</h2>{table}" for name, table in tables.items() if table),
        errors=_errors(study),
        slopes="<h2>How errors fall with the step on smooth cases</h2>" + slopes if study.slopes else "",
        notes="".join(f"<li>{escape(line)}</li>" for line in _notes(study) or ["Nothing was left out."]),
        machine=_machine(study),
        knobs=f"{summary}\n{''.join(knobs)}</details>" if knobs else "",
    )


def _picture(plot: Path, what: str) -> str:
    data = base64.b64encode(plot.read_bytes()).decode("ascii")
    return f'<img alt="{escape(what)}" src="data:image/png;base64,{data}">\n'


def _table(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of words."""
    return _framed("".join(f"<tr>{_cells('td', row)}</tr>\n" for row in rows), head, ' class="words"')


def _framed(body: str, head: Sequence[str], kind: str = "") -> str:
    """A table with its head, of which there may be none."""
    heads = f"<thead><tr>{_cells('th', head)}</tr></thead>" if head else ""
    return f'<div class="scroll"><table{kind}>{heads}\n<tbody>{body}</tbody></table></div>'


def _cells(kind: str, words: Iterable[str]) -> str:
    return "".join(f"<{kind}>{escape(word)}</{kind}>" for word in words)


def _errors(study: Study) -> str:
    measured = {name for row in study.rows for name in row.errors}
    rows = [
        (kind.name, short(kind.name), kind.title, kind.unit or "0 to 1", kind.truth,
         "all scenes together" if kind.pooled else "95th percentile", "yes" if kind.name in measured else "no")
        for kind in ERRORS.values()
    ]  # fmt: skip
    return _table(rows, ("target", "in short", "what it says", "unit", "held against", "over scenes", "measured"))


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
        ("scenes", f"{study.sample} with each of {len(study.rows)} settings"),
        ("preset of the job", study.preset),
        ("a scene as the job is", f"{milliseconds(own.ms)} of processor, {size(own.kilobytes)}"),
    ]
    if study.job_scenes:
        seconds, kilobytes = own.ms * study.job_scenes / 1e3, own.kilobytes * study.job_scenes
        cost = f"{describe_seconds(seconds)} on one core ({number(seconds / 3600)} core-hours), {size(kilobytes)}"
        rows.append((f"the job's {study.job_scenes:,} scenes", cost))
    return _table(rows + [(name.replace("_", " "), _words(value)) for name, value in study.machine.items()])


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_words(inner)}" for name, inner in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_words, value))
    return number(value) if isinstance(value, float) else str(value)


# ---------------------------------------------------------------------------------------------- a part of a scene


def _group_table(study: Study, group: str) -> str:
    """The settings that measured an error of this part, by knob; empty where none did."""
    measured = {name for row in study.rows for name in row.errors}
    names = [kind.name for kind in ERRORS.values() if kind.group == group and kind.name in measured]
    if not names:
        return ""
    whole = [f"{study.job_scenes:,} scenes, one core", "on disk"] if study.job_scenes else ["on disk, a scene"]
    errors = [f"{short(name)}{f', {unit(name)}' if unit(name) else ''}" for name in names]
    head = ["setting", "time", "a scene", *whole, *errors]
    best = {name: front(study.rows, name) for name in names}
    body = ""
    for section, rows in _sections(study.rows, names).items():
        title = f'<tr><th class="knob" colspan="{len(head)}">{escape(section)}</th></tr>\n' if section else ""
        body += title + "".join(_line(study, row, best) for row in rows)
    return _framed(body, head)


def _sections(rows: Sequence[Row], names: Sequence[str]) -> dict[str, list[Row]]:
    """The job, presets, each knob in the order of the table, combinations last; those that measured one of the errors."""
    titles = {"preset": "presets", "several": "several at once"}
    sections: dict[str, list[Row]] = {"": [], "presets": []}
    for row in sorted(rows, key=lambda row: row.setting.kind == "several"):
        if set(row.errors) & set(names):
            sections.setdefault(titles.get(row.setting.kind, row.setting.knob), []).append(row)
    return {name: found for name, found in sections.items() if found}


def _line(study: Study, row: Row, best: Mapping[str, Sequence[Row]]) -> str:
    own = own_row(study.rows)
    same = "≈ " if row is not own and as_cheap(row, own) else ""
    spread = f"<small>{number(row.ratio_least)} – {number(row.ratio_most)}</small>" if row is not own else ""
    called = row.setting.parts[0][1] if len(row.setting.parts) == 1 else row.setting.name
    cells = [escape(called), f"{same}{times(row.ratio)}{spread}", milliseconds(row.ms)]
    if study.job_scenes:
        seconds = row.ms * study.job_scenes / 1e3
        cells.append(f"{describe_seconds(seconds)}<small>{number(seconds / 3600)} core-hours</small>")
    cells.append(size(row.kilobytes * (study.job_scenes or 1)))
    figures = "".join(_figure(name, row, own, rows) for name, rows in best.items())
    kind = ' class="own"' if row is own else ""
    return f"<tr{kind}>{''.join(f'<td>{cell}</td>' for cell in cells)}{figures}</tr>\n"


def _figure(name: str, row: Row, own: Row, best: Sequence[Row]) -> str:
    """One error, marked where it is on the front and where it differs from the job's by more than both intervals."""
    figure = row.errors.get(name)
    if figure is None:
        return "<td>·</td>"
    mine = own.errors.get(name, figure)
    side, mark = ("better", "▼ ") if figure.high < mine.low else ("worse", "▲ ") if figure.low > mine.high else ("", "")
    classes = " ".join(filter(None, [side, "front" if row in best else ""]))
    value, low, high = (number(shown(name, one)) for one in (figure.value, figure.low, figure.high))
    return f'<td class="{classes}">{mark}{value}<small>{low} – {high}</small></td>'
