"""The tables of the page: what each setting costs, and its errors of one part of a scene."""

from collections.abc import Iterator, Sequence
from html import escape

from services.study.choose import as_cheap, front, own_row
from services.study.errors import KINDS
from services.study.model import Figure, Group, Row, Study
from services.study.report.panel import kind_of
from services.study.words import duration, milliseconds, number, short, shown, size, times, unit


def group_table(study: Study, group: Group | str) -> str:
    """The settings that measured an error of this part, by knob; empty where none did."""
    names = [
        kind.name for kind in KINDS if kind.group == group and any(kind.name in row.errors for row in study.rows)
    ]  # fmt: skip
    if not names:
        return ""
    best = {name: front(study.rows, name) for name in names}
    bodies = "\n".join(
        f"<tbody>{_knob_line(knob, study, names)}{''.join(_line(study, row, names, best) for row in rows)}</tbody>"
        for knob, rows in _by_knob(study.rows, names)
    )
    return f'<div class="scroll"><table>{_head(study, names)}\n{bodies}</table></div>'


def _by_knob(rows: Sequence[Row], names: Sequence[str]) -> Iterator[tuple[str, list[Row]]]:
    """The job, presets, each knob in the order of the table, pairs last; those alone that measured one of the errors."""
    sections: dict[str, list[Row]] = {"": [], "presets": []}
    pairs: list[Row] = []
    for row in rows:
        if not set(row.errors) & set(names):
            continue
        kind = kind_of(row)
        section = {"own": "", "preset": "presets"}.get(kind, row.setting.parts[0][0] if row.setting.parts else "")
        (pairs if kind == "pair" else sections.setdefault(section, [])).append(row)
    yield from ((knob, found) for knob, found in [*sections.items(), ("several at once", pairs)] if found)


def _head(study: Study, names: Sequence[str]) -> str:
    whole = [f"{study.job_scenes:,} scenes, one core", "on disk"] if study.job_scenes else ["on disk, a scene"]
    errors = [f"{short(name)}{f', {unit(name)}' if unit(name) else ''}" for name in names]
    cells = "".join(f"<th>{escape(name)}</th>" for name in ["setting", "time", "a scene", *whole, *errors])
    return f"<thead><tr>{cells}</tr></thead>"


def _knob_line(knob: str, study: Study, names: Sequence[str]) -> str:
    columns = 3 + (2 if study.job_scenes else 1) + len(names)
    return f'<tr><th class="knob" colspan="{columns}">{escape(knob)}</th></tr>' if knob else ""


def _line(study: Study, row: Row, names: Sequence[str], best: dict[str, list[Row]]) -> str:
    own = own_row(study.rows)
    same = "≈ " if row is not own and as_cheap(row, own) else ""
    spread = f"<small>{number(row.ratio_least)} – {number(row.ratio_most)}</small>" if row is not own else ""
    seconds, stored = row.ms * study.job_scenes / 1e3, row.kilobytes * (study.job_scenes or 1)
    cost = [f"{same}{times(row.ratio)}{spread}", milliseconds(row.ms)]
    if study.job_scenes:
        cost.append(f"{duration(seconds)}<small>{number(seconds / 3600)} core-hours</small>")
    cells = "".join(f"<td>{cell}</td>" for cell in [*cost, size(stored)])
    figures = "".join(_figure(name, row, own, best[name]) for name in names)
    kind = ' class="own"' if row is own else ""
    return f"<tr{kind}><td>{escape(_called(row))}</td>{cells}{figures}</tr>\n"


def _called(row: Row) -> str:
    return row.setting.parts[0][1] if kind_of(row) in ("single", "preset") else row.setting.name


def _figure(name: str, row: Row, own: Row, best: Sequence[Row]) -> str:
    """One error, marked where it is on the front and where it is other than the job's by more than both intervals."""
    figure = row.errors.get(name)
    if figure is None:
        return "<td>·</td>"
    side = _side(figure, own.errors.get(name))
    classes = " ".join(filter(None, [side, "front" if row in best else ""]))
    mark = {"better": "▼ ", "worse": "▲ "}.get(side, "")
    value, low, high = (number(shown(name, one)) for one in (figure.value, figure.low, figure.high))
    return f'<td class="{classes}">{mark}{value}<small>{low} – {high}</small></td>'


def _side(figure: Figure, own: Figure | None) -> str:
    if own is None:
        return ""
    return "better" if figure.high < own.low else "worse" if figure.low > own.high else ""
