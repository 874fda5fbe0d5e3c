"""The tables of the page: what each setting costs, and its errors of one part of a scene."""

from collections.abc import Mapping, Sequence
from html import escape

from services.study.choose import as_cheap, front, own_row
from services.study.errors import ERRORS
from services.study.model import Figure, Group, Row, Study
from services.study.words import duration, milliseconds, number, short, shown, size, times, unit


def group_table(study: Study, group: Group | str) -> str:
    """The settings that measured an error of this part, by knob; empty where none did."""
    measured = {name for row in study.rows for name in row.errors}
    names = [kind.name for kind in ERRORS.values() if kind.group == group and kind.name in measured]
    if not names:
        return ""
    whole = [f"{study.job_scenes:,} scenes, one core", "on disk"] if study.job_scenes else ["on disk, a scene"]
    errors = [f"{short(name)}{f', {unit(name)}' if unit(name) else ''}" for name in names]
    head = ["setting", "time", "a scene", *whole, *errors]
    best = {name: front(study.rows, name) for name in names}
    bodies = ""
    for section, rows in _sections(study.rows, names).items():
        title = f'<tr><th class="knob" colspan="{len(head)}">{escape(section)}</th></tr>' if section else ""
        bodies += f"<tbody>{title}{''.join(_line(study, row, best) for row in rows)}</tbody>\n"
    cells = "".join(f"<th>{escape(name)}</th>" for name in head)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead>\n{bodies}</table></div>'


def _sections(rows: Sequence[Row], names: Sequence[str]) -> dict[str, list[Row]]:
    """The job, presets, each knob in the order of the table, combinations last; those that measured one of the errors."""
    sections: dict[str, list[Row]] = {"": [], "presets": []}
    several: list[Row] = []
    for row in rows:
        if not set(row.errors) & set(names):
            continue
        if row.setting.kind == "several":
            several.append(row)
        elif row.setting.kind == "single":
            sections.setdefault(row.setting.parts[0][0], []).append(row)
        else:
            sections["" if row.setting.kind == "own" else "presets"].append(row)
    return {name: found for name, found in (sections | {"several at once": several}).items() if found}


def _line(study: Study, row: Row, best: Mapping[str, Sequence[Row]]) -> str:
    own = own_row(study.rows)
    same = "≈ " if row is not own and as_cheap(row, own) else ""
    spread = f"<small>{number(row.ratio_least)} – {number(row.ratio_most)}</small>" if row is not own else ""
    called = row.setting.parts[0][1] if len(row.setting.parts) == 1 else row.setting.name
    cells = [escape(called), f"{same}{times(row.ratio)}{spread}", milliseconds(row.ms)]
    if study.job_scenes:
        seconds = row.ms * study.job_scenes / 1e3
        cells.append(f"{duration(seconds)}<small>{number(seconds / 3600)} core-hours</small>")
    cells.append(size(row.kilobytes * (study.job_scenes or 1)))
    figures = "".join(_figure(name, row, own, rows) for name, rows in best.items())
    kind = ' class="own"' if row is own else ""
    return f"<tr{kind}>{''.join(f'<td>{cell}</td>' for cell in cells)}{figures}</tr>\n"


def _figure(name: str, row: Row, own: Row, best: Sequence[Row]) -> str:
    """One error, marked where it is on the front and where it differs from the job's by more than both intervals."""
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
