"""The files of a study: Parquet tables, the whole study as JSON, and one HTML page that needs nothing beside it."""

import base64
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.errors import describe_seconds, milliseconds, number, size
from services.study.choose import as_cheap, front, own_row, tells
from services.study.model import ERRORS, Proof, Row, Study, amount, short, shown, times, unit

STUDY_FILE = "study.json"
WIDE_FILE = "tradeoff.parquet"
LONG_FILE = "errors.parquet"

STUDY_VERSION = 1
"""The version of the JSON file's format."""

_SETTING = [("setting", pa.string()), ("knob", pa.string()), ("value", pa.string())]
_COST = ("ms", "ratio", "ratio_least", "ratio_most", "kilobytes", "failed_share")

LONG_SCHEMA = pa.schema(
    [
        *_SETTING,
        ("error", pa.string()),
        ("unit", pa.string()),
        ("group", pa.string()),
        *((name, pa.float64()) for name in ("ms", "ratio", "amount", "low", "high", "median")),
        ("scenes", pa.int64()),
    ]
)


def wide_schema() -> pa.Schema:
    """The schema of `tradeoff.parquet`: one row for each setting; an error and its interval are null where not measured."""
    names = sorted(ERRORS, key=lambda name: name in _COST)  # those with a column among the costs last
    figures = [f"{name}{end}" for name in names for end in ("", "_low", "_high") if f"{name}{end}" not in _COST]
    numbers = [(name, pa.float64()) for name in (*_COST, *figures)]
    return pa.schema([*_SETTING, ("changes", pa.string()), *numbers, ("notes", pa.list_(pa.string()))])


def write_tables(study: Study, folder: Path) -> list[Path]:
    """Write `tradeoff.parquet`, `errors.parquet` and `study.json`, each whole or not at all; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    wide = pa.Table.from_pylist([_wide(row) for row in study.rows], wide_schema())
    long = pa.Table.from_pylist([line for row in study.rows for line in _long(row)], LONG_SCHEMA)
    text = json.dumps({"verso_study": STUDY_VERSION, **asdict(study)}, indent=1) + "\n"
    return [
        _replace(folder / WIDE_FILE, lambda file: pq.write_table(wide, file)),
        _replace(folder / LONG_FILE, lambda file: pq.write_table(long, file)),
        _replace(folder / STUDY_FILE, lambda file: file.write_text(text, encoding="utf-8")),
    ]


def _names(row: Row) -> dict[str, str]:
    """A setting's name, knobs and values; those of a combination are joined by commas."""
    knobs, values = (", ".join(part[place] for part in row.setting.parts) for place in (0, 1))
    return {"setting": row.setting.name, "knob": knobs, "value": values}


def _wide(row: Row) -> dict[str, Any]:
    line: dict[str, Any] = {**_names(row), "changes": json.dumps(dict(row.setting.changes)), "notes": list(row.notes)}
    for name, figure in row.errors.items():
        line |= {name: figure.value, f"{name}_low": figure.low, f"{name}_high": figure.bound}
    return line | {name: getattr(row, name) for name in _COST}


def _long(row: Row) -> list[dict[str, Any]]:
    setting = {**_names(row), "ms": row.ms, "ratio": row.ratio}
    return [
        {**asdict(figure), **setting, "high": figure.bound, "amount": figure.value, "error": name}
        | {"unit": ERRORS[name].unit, "group": ERRORS[name].group}
        for name, figure in row.errors.items()
    ]


def _replace(file: Path, write: Callable[[Path], Any]) -> Path:
    """Write under another name in the same folder, then rename, so that no reader sees half a file."""
    partial = file.with_name(f".{file.name}.{os.getpid()}")
    write(partial)
    os.replace(partial, file)
    return file


TEMPLATE = Path(__file__).with_name("page.html")

GROUPS = {
    "physics": "How objects rest",
    "labels": "Depth and masks",
    "mirror": "The other side",
    "colour": "Colour",
    "capture": "Captures",
}


def write_page(study: Study, plots: Sequence[Path], file: Path) -> None:
    """Write the page with the pictures in it: the first of `plots` on top, then one a knob."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(page_of(study, plots), encoding="utf-8")


def page_of(study: Study, plots: Sequence[Path]) -> str:
    """The whole page."""
    tables = {name: table for group, name in GROUPS.items() if (table := _group_table(study, group))}
    knobs = [_picture(plot, f"Errors over time along the knob {plot.stem.removeprefix('knob_')}") for plot in plots[1:]]
    summary = '<details open class="knobs"><summary>Each knob by itself</summary>'
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        job=escape(study.job),
        answer=escape(study.answer),
        proof=_proofs(study),
        doubts="".join(f'<p class="doubt">Not decided: {escape(line)}.</p>' for line in study.doubts),
        tradeoff="".join(_picture(plot, "Errors over processor time, a point for each setting") for plot in plots[:1]),
        groups="\n".join(f"<h2>{name}</h2>{table}" for name, table in tables.items()),
        errors=_errors(study),
        notes="".join(f"<li>{escape(line)}</li>" for line in _notes(study) or ["Nothing was left out."]),
        machine=_machine(study),
        knobs=f"{summary}\n{''.join(knobs)}</details>" if knobs else "",
    )


def _picture(plot: Path, what: str) -> str:
    data = base64.b64encode(plot.read_bytes()).decode("ascii")
    return f'<img class="plot" alt="{escape(what)}" src="data:image/png;base64,{data}">\n'


def _table(body: str | Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of words, or of lines in HTML, with its head, of which there may be none."""
    kind = "" if isinstance(body, str) else ' class="words"'
    lines = body if isinstance(body, str) else "".join(f"<tr>{_cells('td', row)}</tr>\n" for row in body)
    heads = f"<thead><tr>{_cells('th', head)}</tr></thead>" if head else ""
    return f'<div class="scroll"><table{kind}>{heads}\n<tbody>{lines}</tbody></table></div>'


def _cells(kind: str, words: Iterable[str]) -> str:
    return "".join(f"<{kind}>{escape(word)}</{kind}>" for word in words)


def describe_proof(proof: Proof) -> str:
    """One line: what was promised and measured, and whether it holds."""
    words = [
        f"{short(name)} {amount(name, proof.measured[name].value)}"
        + (f", promised {amount(name, proof.promised[name].value)}" if name in proof.promised else "")
        + f" (at most {amount(name, most)})"
        for name, most in proof.targets.items()
    ]
    end = "holds" if proof.holds else "does not hold: withdrawn"
    return f"{proof.setting} on {proof.scenes} fresh scenes: {'; '.join(words)}: {end}"


def _proofs(study: Study) -> str:
    rows = [
        (proof.setting, str(proof.scenes), short(name), amount(name, most),
         amount(name, proof.promised[name].value) if name in proof.promised else "as the job",
         amount(name, proof.measured[name].value), "yes" if proof.measured[name].value <= most else "no: withdrawn")
        for proof in study.proofs for name, most in proof.targets.items()
    ]  # fmt: skip
    head = ("setting", "fresh scenes", "error", "at most", "promised", "measured", "holds")
    return f"<h2>Promised, and measured on fresh scenes</h2>{_table(rows, head)}" if rows else ""


def _errors(study: Study) -> str:
    measured = {name for row in study.rows for name in row.errors}
    rows = [
        (kind.name, kind.short, kind.title, kind.unit or "0 to 1", kind.truth,
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
        ("scenes", study.sample),
        ("time spent", f"{describe_seconds(study.seconds)} of a budget of {describe_seconds(study.budget_s)}"),
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
    return _table(body, head)


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
    """One error, marked where it is on the front and where it differs from the job's by more than both intervals.

    Fewer scenes than tell anything are pale.
    """
    figure = row.errors.get(name)
    if figure is None:
        return "<td>·</td>"
    mine, side, mark = own.errors.get(name, figure), "", ""
    if not tells(row, name):
        side = "few"
    elif figure.high < mine.low:
        side, mark = "better", "▼ "
    elif figure.low > mine.high:
        side, mark = "worse", "▲ "
    classes = " ".join(filter(None, [side, "front" if row in best else ""]))
    value, low, high = (number(shown(name, one)) for one in (figure.value, figure.low, figure.bound))
    return f'<td class="{classes}">{mark}{value}<small>{low} – {high}</small></td>'
