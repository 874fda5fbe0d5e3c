"""The files of a study: the table as Parquet, all of it as JSON, a picture, and one HTML page that needs nothing beside it."""

import base64
import io
import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from html import escape
from itertools import cycle, zip_longest
from pathlib import Path
from string import Template
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.cbook import pts_to_poststep
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from pydantic import TypeAdapter

from schemas.errors import describe_seconds, milliseconds, number, plural, size
from services.study.choose import front, own_row, tells
from services.study.model import ERRORS, Proof, Row, Study, amount, short, shown, times, unit
from workers.assets.library.table import write_whole

_COST = ("ms", "ratio", "ratio_least", "ratio_most", "kilobytes", "failed_share")


def table_of(rows: Sequence[Row]) -> pa.Table:
    """A row for each setting: knobs and values of a combination joined by commas, its cost, and each error with its interval.

    Only errors that were measured have columns; they are null in settings that did not measure them.
    """
    measured = [name for name in ERRORS if any(name in row.errors for row in rows)]
    ends = {"": "value", "_low": "low", "_high": "most"}
    lines = []
    for row in rows:
        knob, value = (", ".join(part[place] for part in row.setting.parts) for place in (0, 1))
        words = {"setting": row.setting.name, "knob": knob, "value": value, "notes": "; ".join(row.notes)}
        figures = {
            f"{name}{end}": getattr(row.errors.get(name), key, None) for name in measured for end, key in ends.items()
        }
        costs = {name: getattr(row, name) for name in _COST}
        lines.append({**words, "changes": json.dumps(dict(row.setting.changes)), **figures, **costs})
    return pa.Table.from_pylist(lines)


def write_study(study: Study, folder: Path) -> None:
    """Write `tradeoff.parquet`, `study.json`, `tradeoff.png` and `index.html`, each whole or not at all. Raises OutputError."""
    table, picture = io.BytesIO(), draw_tradeoff(study)
    pq.write_table(table_of(study.rows), table)
    text = json.dumps({"verso_study": 2, **asdict(study)}, indent=1) + "\n"
    for name, data in {
        "tradeoff.parquet": table.getvalue(),
        "study.json": text.encode(),
        "tradeoff.png": picture,
        "index.html": page_of(study, picture).encode(),
    }.items():
        write_whole(folder / name, data)


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
    notes = [f"{row.setting.name}: {note}" for row in study.rows for note in row.notes]
    tables = {name: table for group, name in GROUPS.items() if (table := _group_table(study, group))}
    return Template(Path(__file__).with_name("page.html").read_text(encoding="utf-8")).substitute(
        job=escape(study.job),
        answer=escape(study.answer),
        proof="".join(f"<p>Proved: {escape(describe_proof(proof))}.</p>" for proof in study.proofs),
        doubts="".join(f'<p class="doubt">Not decided: {escape(line)}.</p>' for line in study.doubts),
        tradeoff=f'<img class="plot" alt="Errors over processor time" src="data:image/png;base64,{data}">',
        groups="\n".join(f"<h2>{name}</h2>{table}" for name, table in tables.items()),
        errors=_list(_errors(study)),
        notes=_list([*study.notes, *notes]),
        machine=_list(f"{name}: {value}" for name, value in _machine(study).items()),
    )


def _list(lines: Iterable[str]) -> str:
    return "".join(f"<li>{escape(line)}</li>" for line in lines)


def describe_proof(proof: Proof) -> str:
    """One line: what was promised and measured, and whether it holds."""
    words = []
    for name, most in proof.targets.items():
        promised = f", promised {amount(name, proof.promised[name].value)}" if name in proof.promised else ""
        words.append(
            f"{short(name)} {amount(name, proof.measured[name].value)}{promised} (at most {amount(name, most)})"
        )
    end = "holds" if proof.holds else "does not hold: withdrawn"
    return f"{proof.setting} on {proof.scenes} fresh scenes: {'; '.join(words)}: {end}"


def _errors(study: Study) -> list[str]:
    kinds = [kind for name, kind in ERRORS.items() if any(name in row.errors for row in study.rows)]
    over = {True: "all scenes together", False: "95th percentile of scenes"}
    return [
        f"{kind.name} ({kind.unit or '0 to 1'}), {kind.short}: {kind.title}, against {kind.truth}; {over[kind.pooled]}"
        for kind in kinds
    ]


def _machine(study: Study) -> dict[str, str]:
    own = own_row(study.rows)
    hours = number(own.ms * study.job_scenes / 3.6e6)
    return {
        "command": study.command,
        "scenes": sample(study),
        "time spent": f"{describe_seconds(study.seconds)} of a budget of {describe_seconds(study.budget_s)}",
        f"the job's {study.job_scenes:,} scenes": f"{hours} core-hours, {size(own.kilobytes * study.job_scenes)}",
        **{name: value if isinstance(value, str) else json.dumps(value) for name, value in study.machine.items()},
    }


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
    heads = "".join(f"<th>{escape(word)}</th>" for word in head)
    table = f"<table><thead><tr>{heads}</tr></thead>\n<tbody>{''.join(lines)}</tbody></table>"
    return f'<div class="scroll">{table}</div>' if lines else ""


def _line(study: Study, row: Row, best: Mapping[str, Sequence[Row]]) -> str:
    own = own_row(study.rows)
    same = "≈ " if row is not own and row.ratio_least <= 1.0 <= row.ratio_most else ""
    ends = f"{number(row.ratio_least)} – {number(row.ratio_most)}" if row.ratio_most < math.inf else "of one scene"
    spread = f"<small>{ends}</small>" if row is not own else ""
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
    mine = own.errors.get(name, figure)
    marks = {"worse": "▲ "} if figure.low > mine.high else {"better": "▼ "} if figure.high < mine.low else {"": ""}
    ((side, mark),) = marks.items() if tells(row, name) else (("few", ""),)
    value, low, high = (number(shown(name, end)) for end in (figure.value, figure.low, figure.most))
    ends = f"{low} – {high}" if tells(row, name) else f"of {plural(figure.scenes, 'scene')}"
    return f'<td class="{side}{" front" * is_best}">{mark}{value}<small>{ends}</small></td>'


PANELS, WIDE_IN, MOVED, REACH, FLOOR = 4, 5.2, 0.05, 4.0, 1e-3
"""The most panels of a picture; changes up to this share of the job's own error are negligible too; an interval is cut where it
reaches beyond this many times its middle, and what is below this share of the negligible stands there: either fills the axis."""

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
    """A PNG with a panel for each error that a knob moves, over processor time, both logarithmic: the first of each group first.

    One below another, narrow enough to be read on a phone: `WIDE_IN` on the 390 points of one leave letters of 9 points.
    """
    every = {name: moving_rows(study.rows, name) for name in ERRORS}
    moving = {name: rows for name, rows in every.items() if any(row.setting.kind == "single" for row in rows)}
    telling = {name for name, rows in moving.items() if sum(tells(row, name) for row in rows) > 1} or moving
    by_group = [[name for name in moving if name in telling and ERRORS[name].group == group] for group in GROUPS]
    panels = [name for rank in zip_longest(*by_group) for name in rank if name is not None][:PANELS]
    picture = Picture((WIDE_IN, max(1, len(panels)) * 3.6 + 1.6), dpi=150, layout="constrained")
    title = f"{study.job[:40]}: {milliseconds(own_row(study.rows).ms)} a scene\n{sample(study)}"
    picture.suptitle(title, x=0.01, ha="left", fontsize=10.5, fontweight="bold")
    knobs = dict.fromkeys(row.setting.knob for row in study.rows if row.setting.kind == "single")
    looks = {knob: look for knob, *look in zip(knobs, cycle(COLORS), cycle("o^svPX"), strict=False)}
    legend: dict[str, Any] = {}
    for place, name in enumerate(panels, start=1):
        axes = picture.add_subplot(len(panels), 1, place)
        axes.set_title(question_of(study.rows, name), loc="left", x=-0.12, fontsize=9.5)
        _draw_panel(axes, moving[name], name, looks)
        handles, labels = axes.get_legend_handles_labels()
        legend |= dict(zip(labels, handles, strict=True))
    if legend:
        picture.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=2, frameon=False)
    data = io.BytesIO()
    # Neither a date nor the library's name, so that the same study gives the same bytes.
    picture.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()


def question_of(rows: Sequence[Row], error: str) -> str:
    """What a panel asks, and what is surely so: the cheapest of the fewest changes whose interval is below the job's.

    An answer only where `FEWEST_SCENES` measured both.
    """
    own, words = own_row(rows), f"{short(error)}: what does less cost?"
    if not tells(own, error):
        return words
    value, negligible = own.errors[error].value, ERRORS[error].negligible
    if value <= negligible:
        return f"{words}\nNothing to gain: the job's is at most {amount(error, max(value, FLOOR * negligible))}, as good as none."
    able = [row for row in rows if row is not own and tells(row, error)]
    better = [row for row in able if row.errors[error].high < own.errors[error].low]
    if not better:
        return f"{words}\nNothing that was measured is surely better than the job."
    row = min(better, key=lambda row: (len(row.setting.parts), row.ratio, row.setting.name))
    less = 1.0 - row.errors[error].value / value
    span = f"{number(row.ratio_least)} to {number(row.ratio_most)}"
    return f"{words}\n{row.setting.name[:30]}: {less:.0%} less, {times(row.ratio)} the time ({span})"


def moving_rows(rows: Sequence[Row], error: str) -> list[Row]:
    """The job, presets, knobs of which a value moves the error by more than what is negligible, and combinations with these."""
    measured = [row for row in rows if error in row.errors]
    own = own_row(rows).errors.get(error)
    value, least = (own.value, max(ERRORS[error].negligible, MOVED * own.value)) if own else (0.0, -1.0)
    single = [row for row in measured if row.setting.kind == "single"]
    moving = {row.setting.knob for row in single if abs(row.errors[error].value - value) > least}
    return [row for row in measured if row.setting.kind in ("own", "preset") or set(dict(row.setting.parts)) & moving]


def _draw_panel(axes: Axes, rows: Sequence[Row], error: str, looks: Mapping[str, Sequence[str]]) -> None:
    """Points by knob with their intervals and, beside those of the front and the presets, their values; and the front."""
    best = front(rows, error)
    least = FLOOR * ERRORS[error].negligible if any(row.errors[error].value > 0.0 for row in rows) else 0.0
    place = {row.setting.name: (row.ms, shown(error, max(least, row.errors[error].value))) for row in rows}
    for row in rows:
        mark, figure = dict(MARKS[row.setting.kind]), row.errors[error]
        if row.setting.kind == "single":
            color, marker = looks[row.setting.knob]
            mark |= {"color": color, "marker": marker, "label": row.setting.knob}
        if not tells(row, error):
            mark |= {"alpha": 0.4}  # fewer than `FEWEST_SCENES` scenes, whose interval says nothing
        else:
            ends = max(figure.low, figure.value / REACH), min(figure.most, figure.value * REACH)
            low, high = (max(least, end) for end in ends)
            axes.vlines(row.ms, shown(error, low), shown(error, high), color=mark["color"], lw=0.8, alpha=0.5)
        axes.plot(*place[row.setting.name], ls="", **mark)
        if row.setting.kind == "preset" or (row in best and row.setting.kind == "single"):
            text = row.setting.parts[0][1][:26]
            # Those of one place stay apart, and off what lies beside it.
            beside, ha = ((0.0, -17.0), "center") if row.setting.kind == "preset" else ((6.0, 4.0), "left")
            axes.annotate(text, place[row.setting.name], beside, textcoords="offset points", ha=ha, zorder=6)
    if best:
        corners = pts_to_poststep(*zip(*(place[row.setting.name] for row in best), strict=True))
        axes.plot(*corners, color="#222222", lw=1.3, zorder=2, label="front: none is cheaper and better")
    axes.set_xscale("log")
    axes.margins(y=0.15)  # room for words
    axes.set_yscale("log" if least > 0.0 else "linear")
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            low, high = axis.get_view_interval()
            subs = (1.0,) if high > 1e2 * low else (1.0, 2.0, 5.0)
            axis.set_major_locator(LogLocator(subs=subs, numticks=6) if high > 4.0 * low else MaxNLocator(4))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.set(xlabel="ms of processor a scene", ylabel=", ".join(filter(None, [short(error), unit(error)])))
    axes.grid(color="#e8e8e8")
    axes.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":  # draws the pictures of kept studies anew: python -m services.study.page docs/tradeoff/*
    for folder in map(Path, sys.argv[1:]):
        kept = TypeAdapter(Study).validate_json((folder / "study.json").read_bytes())
        (folder / "tradeoff.png").write_bytes(draw_tradeoff(kept))
