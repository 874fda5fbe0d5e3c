"""The files of a study: the table as Parquet, all of it as JSON, a picture, and one HTML page that needs nothing beside it."""

import base64
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from html import escape
from itertools import cycle
from pathlib import Path
from string import Template
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.cbook import pts_to_poststep
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from schemas.errors import describe_seconds, milliseconds, number, size
from services.study.choose import front, own_row, tells
from services.study.model import ERRORS, Proof, Row, Study, amount, short, shown, times, unit

STUDY_VERSION = 2
"""The version of the JSON file's format."""

_COST = ("ms", "ratio", "ratio_least", "ratio_most", "kilobytes", "failed_share")


def wide_schema() -> pa.Schema:
    """The schema of `tradeoff.parquet`: one row for each setting; an error and its interval are null where not measured."""
    figures = [f"{name}{end}" for name in ERRORS for end in ("", "_low", "_high") if f"{name}{end}" not in _COST]
    texts = [(name, pa.string()) for name in ("setting", "knob", "value", "changes")]
    numbers = [(name, pa.float64()) for name in (*_COST, *figures)]
    return pa.schema([*texts, *numbers, ("notes", pa.list_(pa.string()))])


def _wide(row: Row) -> dict[str, Any]:
    """A row of the table; knobs and values of a combination are joined by commas."""
    knob, value = (", ".join(part[place] for part in row.setting.parts) for place in (0, 1))
    line: dict[str, Any] = {"setting": row.setting.name, "knob": knob, "value": value, "notes": list(row.notes)}
    for name, figure in row.errors.items():
        line |= {name: figure.value, f"{name}_low": figure.low, f"{name}_high": figure.most}
    return line | {name: getattr(row, name) for name in _COST} | {"changes": json.dumps(dict(row.setting.changes))}


def write_study(study: Study, folder: Path) -> None:
    """Write `tradeoff.parquet`, `study.json`, `tradeoff.png` and `index.html`, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    table, picture = io.BytesIO(), draw_tradeoff(study)
    pq.write_table(pa.Table.from_pylist([_wide(row) for row in study.rows], wide_schema()), table)
    text = json.dumps({"verso_study": STUDY_VERSION, **asdict(study)}, indent=1) + "\n"
    for name, data in {
        "tradeoff.parquet": table.getvalue(),
        "study.json": text.encode(),
        "tradeoff.png": picture,
        "index.html": page_of(study, picture).encode(),
    }.items():
        partial = folder / f".{name}.{os.getpid()}"
        partial.write_bytes(data)
        os.replace(partial, folder / name)


# ---------------------------------------------------------------------------------------------- the page

TEMPLATE = Path(__file__).with_name("page.html")

GROUPS = {
    "physics": "How objects rest",
    "labels": "Depth and masks",
    "mirror": "The other side",
    "colour": "Colour",
    "capture": "Captures",
}


def page_of(study: Study, picture: bytes) -> str:
    """The whole page, with the picture in it."""
    data = base64.b64encode(picture).decode("ascii")
    tables = {name: table for group, name in GROUPS.items() if (table := _group_table(study, group))}
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        job=escape(study.job),
        answer=escape(study.answer),
        proof=_proofs(study),
        doubts="".join(f'<p class="doubt">Not decided: {escape(line)}.</p>' for line in study.doubts),
        tradeoff=f'<img class="plot" alt="Errors over processor time" src="data:image/png;base64,{data}">',
        groups="\n".join(f"<h2>{name}</h2>{table}" for name, table in tables.items()),
        errors=_errors(study),
        notes="".join(f"<li>{escape(line)}</li>" for line in _notes(study) or ["Nothing was left out."]),
        machine=_machine(study),
    )


def _table(body: str, head: Sequence[str] = (), kind: str = "") -> str:
    """A table of lines in HTML, with its head, of which there may be none."""
    heads = f"<thead><tr>{_cells('th', head)}</tr></thead>" if head else ""
    return f'<div class="scroll"><table class="{kind}">{heads}\n<tbody>{body}</tbody></table></div>'


def _words(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of words."""
    return _table("".join(f"<tr>{_cells('td', row)}</tr>\n" for row in rows), head, "words")


def _cells(kind: str, words: Iterable[str]) -> str:
    return "".join(f"<{kind}>{escape(word)}</{kind}>" for word in words)


def _proof_rows(proof: Proof) -> list[tuple[str, str, str, str, str]]:
    """Of each target: the error in words, what is allowed, promised and measured, and whether that holds."""
    return [
        (short(name), amount(name, most),
         amount(name, proof.promised[name].value) if name in proof.promised else "as the job",
         amount(name, proof.measured[name].value), "no: withdrawn" if name in proof.missed else "yes")
        for name, most in proof.targets.items()
    ]  # fmt: skip


def describe_proof(proof: Proof) -> str:
    """One line: what was promised and measured, and whether it holds."""
    words = [f"{row[0]} {row[3]}, promised {row[2]} (at most {row[1]})" for row in _proof_rows(proof)]
    end = "holds" if proof.holds else "does not hold: withdrawn"
    return f"{proof.setting} on {proof.scenes} fresh scenes: {'; '.join(words)}: {end}"


def _proofs(study: Study) -> str:
    rows = [(proof.setting, str(proof.scenes), *row) for proof in study.proofs for row in _proof_rows(proof)]
    head = ("setting", "fresh scenes", "error", "at most", "promised", "measured", "holds")
    return f"<h2>Promised, and measured on fresh scenes</h2>{_words(rows, head)}" if rows else ""


def _errors(study: Study) -> str:
    measured = {name for row in study.rows for name in row.errors}
    rows = [
        (kind.name, kind.short, kind.title, kind.unit or "0 to 1", kind.truth,
         "all scenes together" if kind.pooled else "95th percentile", "yes" if kind.name in measured else "no")
        for kind in ERRORS.values()
    ]  # fmt: skip
    return _words(rows, ("target", "in short", "what it says", "unit", "held against", "over scenes", "measured"))


def _notes(study: Study) -> list[str]:
    """The study's notes, then its settings' notes, each once with the names of its settings."""
    about: dict[str, list[str]] = {}
    for row in study.rows:
        for note in row.notes:
            about.setdefault(note, []).append(row.setting.name)
    return [*study.notes, *(f"{note} ({', '.join(names)})" for note, names in about.items())]


def _machine(study: Study) -> str:
    own = own_row(study.rows)
    hours = number(own.ms * study.job_scenes / 3.6e6)
    rows = [
        ("command", study.command),
        ("scenes", sample(study)),
        ("time spent", f"{describe_seconds(study.seconds)} of a budget of {describe_seconds(study.budget_s)}"),
        ("preset of the job", study.preset),
        ("a scene as the job is", f"{milliseconds(own.ms)} of processor, {size(own.kilobytes)}"),
        (f"the job's {study.job_scenes:,} scenes", f"{hours} core-hours, {size(own.kilobytes * study.job_scenes)}"),
    ]
    return _words([*rows, *((name.replace("_", " "), _value(value)) for name, value in study.machine.items())])


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_value(inner)}" for name, inner in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_value, value))
    return number(value) if isinstance(value, float) else str(value)


def sample(study: Study) -> str:
    """What was measured, in words."""
    return f"up to {study.scenes} scenes with each of {len(study.rows)} settings"


def _group_table(study: Study, group: str) -> str:
    """The settings that measured an error of this part: the job, presets, each knob, combinations; empty where none did."""
    measured = {name for row in study.rows for name in row.errors}
    names = [kind.name for kind in ERRORS.values() if kind.group == group and kind.name in measured]
    errors = [", ".join(filter(None, [short(name), unit(name)])) for name in names]
    head = ["setting", "time", "a scene", f"{study.job_scenes:,} scenes, one core", "on disk", *errors]
    best = {name: front(study.rows, name) for name in names}
    order = {"own": 0, "preset": 1, "single": 2, "several": 3}
    rows = [row for row in study.rows if set(row.errors) & set(names)]
    lines = [_line(study, row, best) for row in sorted(rows, key=lambda row: order[row.setting.kind])]
    return _table("".join(lines), head) if lines else ""


def _line(study: Study, row: Row, best: Mapping[str, Sequence[Row]]) -> str:
    own = own_row(study.rows)
    same = "≈ " if row is not own and row.ratio_least <= 1.0 <= row.ratio_most else ""
    spread = f"<small>{number(row.ratio_least)} – {number(row.ratio_most)}</small>" if row is not own else ""
    cells = [
        escape(row.setting.name),
        f"{same}{times(row.ratio)}{spread}",
        milliseconds(row.ms),
        describe_seconds(row.ms * study.job_scenes / 1e3),
        size(row.kilobytes * study.job_scenes),
    ]
    figures = "".join(_figure(name, row, own, row in rows) for name, rows in best.items())
    return f'<tr class="{row.setting.kind}">{"".join(f"<td>{cell}</td>" for cell in cells)}{figures}</tr>\n'


def _figure(name: str, row: Row, own: Row, is_best: bool) -> str:
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
    value, low, high = (number(shown(name, end)) for end in (figure.value, figure.low, figure.most))
    return f'<td class="{side}{" front" * is_best}">{mark}{value}<small>{low} – {high}</small></td>'


# ---------------------------------------------------------------------------------------------- the picture

PANELS = {
    "How objects rest": ("pose_mm", "outcome_mm", "penetration_mm", "gap_mm", "unbalanced_share", "outcome_deg"),
    "Depth and masks": ("between_mm", "depth_mm", "outline_share", "mask_share", "table_depth_mm"),
    "The other side": ("mirror_mm", "agreement_mm", "unfilled_share", "hidden_share"),
    "Colour": ("flip", "edge_flip"),
    "Camera poses": ("camera_mm", "camera_deg"),
    "Merged cloud": ("cloud_mm", "cloud_p95_mm"),
    "What is missing": ("missing_share",),
    "Synthesised views": ("view_depth_mm",),
}
"""The errors of each panel, of which it shows the first that a setting moves."""

MOVED = 0.05
"""A knob that moves an error by no more than this share of the job's own is left out of its panel."""

REACH = 4.0
"""An interval is cut where it reaches beyond this many times its middle, which would otherwise fill the axis."""

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#6F6800")
"""Okabe and Ito's palette for colour-blind readers, the yellow darker so that it is seen on white."""

MARKS: Mapping[str, dict[str, Any]] = {
    "own": {"label": "the job as it is", "color": "black", "marker": "*", "ms": 16.0, "mec": "white", "zorder": 5},
    "preset": {"label": "preset", "color": "black", "marker": "s", "ms": 10.0, "mfc": "none", "mew": 1.5, "zorder": 4},
    "several": {"label": "several knobs at once", "color": "#777777", "marker": "d", "ms": 6.5, "mfc": "white"},
    "single": {"ms": 6.5, "mec": "white", "mew": 0.6, "zorder": 4},
}
"""Markers by the kind of setting; of one knob it has the knob's colour and form."""


@style.context(["default", {"font.family": "DejaVu Sans", "font.size": 9.5, "axes.edgecolor": "#888888"}])
def draw_tradeoff(study: Study) -> bytes:
    """A PNG with a panel for each part of a scene: its main error over processor time, both logarithmic."""
    every = {name: moving_rows(study.rows, name) for name in ERRORS}
    moving = {name: rows for name, rows in every.items() if any(row.setting.kind == "single" for row in rows)}
    shown_errors = {head: next((name for name in names if name in moving), None) for head, names in PANELS.items()}
    panels = {head: name for head, name in shown_errors.items() if name is not None}
    lines = max(1, -(-len(panels) // 2))
    picture = Picture((12.0, lines * 4.6 + 1.0), dpi=150, layout="constrained")
    title = f"{study.job[:40]}: a scene takes {milliseconds(own_row(study.rows).ms)}; {sample(study)}"
    picture.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold")
    knobs = dict.fromkeys(row.setting.knob for row in study.rows if row.setting.kind == "single")
    looks = {knob: look for knob, *look in zip(knobs, cycle(COLORS), cycle("o^svPX"), strict=False)}
    legend: dict[str, Any] = {}
    for place, (head, name) in enumerate(panels.items(), start=1):
        axes = picture.add_subplot(lines, 2, place)
        axes.set_title(head, loc="left", fontsize=11)
        _draw_panel(axes, moving[name], name, looks)
        handles, labels = axes.get_legend_handles_labels()
        legend |= dict(zip(labels, handles, strict=True))
    if legend:
        picture.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=5, frameon=False)
    data = io.BytesIO()
    # Neither a date nor the library's name, so that the same study gives the same bytes.
    picture.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()


def moving_rows(rows: Sequence[Row], error: str) -> list[Row]:
    """The settings that a panel shows.

    The job, presets, knobs of which a value moves the error by more than `MOVED` and what is negligible, and combinations with
    such a knob.
    """
    measured = [row for row in rows if error in row.errors]
    own = own_row(rows).errors.get(error)
    least = max(ERRORS[error].negligible, MOVED * own.value) if own else -1.0
    value = own.value if own else 0.0
    single = [row for row in measured if row.setting.kind == "single"]
    moving = {row.setting.knob for row in single if abs(row.errors[error].value - value) > least}
    return [row for row in measured if row.setting.kind in ("own", "preset") or set(dict(row.setting.parts)) & moving]


def _draw_panel(axes: Axes, rows: Sequence[Row], error: str, looks: Mapping[str, Sequence[str]]) -> None:
    """Points by knob with their intervals and, beside those of the front and the presets, their values; and the front."""
    best = front(rows, error)
    place = {row.setting.name: (row.ms, shown(error, row.errors[error].value)) for row in rows}
    for row in rows:
        mark, figure = dict(MARKS[row.setting.kind]), row.errors[error]
        if row.setting.kind == "single":
            color, marker = looks[row.setting.knob]
            mark |= {"color": color, "marker": marker, "label": row.setting.knob}
        if not tells(row, error):
            mark |= {"alpha": 0.4}  # fewer than `FEWEST_SCENES` scenes
        low, high = max(figure.low, figure.value / REACH), min(figure.most, figure.value * REACH)
        axes.vlines(row.ms, shown(error, low), shown(error, high), color=mark["color"], lw=0.8, alpha=0.5)
        axes.plot(*place[row.setting.name], ls="", **mark)
        if row.setting.kind in ("own", "preset") or (row in best and row.setting.kind == "single"):
            text = row.setting.parts[0][1][:26] if row.setting.parts else "the job"
            at = (-6.0, -12.0) if row.setting.kind == "own" else (6.0, 3.0)
            side = "right" if row.setting.kind == "own" else "left"
            axes.annotate(text, place[row.setting.name], at, textcoords="offset points", ha=side, zorder=6)
    if best:
        corners = pts_to_poststep(*zip(*(place[row.setting.name] for row in best), strict=True))
        axes.plot(*corners, color="#222222", lw=1.3, zorder=2, label="front: none is cheaper and better")
    values = [value for _, value in place.values()]
    axes.set_xscale("log")
    axes.set_yscale(**({"value": "log"} if min(values) > 0.0 else _linear_below(values)))
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            low, high = axis.get_view_interval()
            subs = (1.0, 2.0, 5.0) if high > 4.0 * low else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
            axis.set_major_locator(LogLocator(subs=subs, numticks=8))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.set(xlabel="ms of processor a scene", ylabel=", ".join(filter(None, [short(error), unit(error)])))
    axes.grid(color="#e8e8e8")
    axes.spines[["top", "right"]].set_visible(False)


def _linear_below(values: Sequence[float]) -> dict[str, Any]:
    """A logarithmic axis that is linear from 0 to the least value above 0."""
    return {"value": "symlog", "linthresh": min((value for value in values if value > 0.0), default=1.0)}
