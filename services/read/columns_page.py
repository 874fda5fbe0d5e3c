"""Writes docs/columns.md and what `verso columns` prints: every column of every table, from the table of columns."""

import textwrap
from dataclasses import replace
from typing import Any

from schemas.dataset.tables import COLUMNS, FRAMES, SORT_KEYS, TABLES, Column
from schemas.errors import InputError, did_you_mean

WIDTH = 100
"""Columns of a terminal that meanings are wrapped to."""

HEADER = """\
# Columns of the tables

Written from `schemas/dataset/` by `python -m services.read.columns_page`. `./verso columns TABLE` prints the same.

After a column's name: its type, unit and frame. `1` is a pure number, `id` and `count` are whole numbers. `T_a_b` takes
coordinates in frame b to frame a, 4 x 4. `name[]` stands for the items of a list. A column marked "scenes" or
"captures" is null in datasets of the other kind, with all that is inside it; one marked "targets" where the job asks for none.

Frames:

"""


def list_columns(table: str | None) -> list[dict[str, Any]]:
    """Every column of one table, or of all, for programs. Raises InputError for a table that is not."""
    return [
        {"table": name, "captures_only": column.path.partition(".")[0] == "capture"}
        | {key: getattr(column, key) for key in ("path", "type", "nullable", "meaning", "unit", "frame")}
        for name in _chosen(table)
        for column in COLUMNS[name]
    ]


def require_table(name: str) -> None:
    """Raises InputError where a dataset has no table of this name."""
    if name not in TABLES:
        raise InputError(f"there is no table {name!r}; {did_you_mean(name, TABLES)}Tables are {', '.join(TABLES)}")


def _chosen(table: str | None) -> tuple[str, ...]:
    if table is not None:
        require_table(table)
    return (table,) if table else tuple(TABLES)


def describe_columns(table: str | None) -> list[str]:
    """The lines that `verso columns` prints. Raises InputError for a table that is not."""
    lines = []
    for name in _chosen(table):
        lines += [f"{name}: {TABLES[name]}", f"  key: {', '.join(SORT_KEYS[name])}"]
        for column in COLUMNS[name]:
            lines.append(f"  {column.path}  ({_facts(column)})")
            lines += textwrap.wrap(column.meaning, WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
        lines.append("")
    return lines[:-1]


def _facts(column: Column) -> str:
    """Type, unit and frame in a few words."""
    by_rows = " by rows" if column.type == "double[16]" else ""
    words = [f"{column.type}{by_rows}{' or null' if column.null else ''}", column.unit]
    words += [f"{' from '.join(column.frame.split(', '))}" if column.frame else ""]
    return ", ".join(word for word in [*words, "" if column.of == "both" else column.of] if word)


def _alike(column: Column) -> Column:
    """What columns that share a line of the page agree in."""
    return replace(column, path="", of="both")


def write_page() -> str:
    """The text of docs/columns.md."""
    lines = [HEADER + "\n".join(f"- **{name}**: {text}" for name, text in FRAMES.items())]
    first: dict[Column, str] = {}
    for table in TABLES:
        lines += [
            "",
            f"## {table}",
            "",
            f"{TABLES[table]} Key: {', '.join(f'`{key}`' for key in SORT_KEYS[table])}.",
            "",
        ]
        new, again = dict[Column, list[str]](), dict[str, list[str]]()
        for column in COLUMNS[table]:
            other = first.setdefault(column, table)
            # what is inside a marked column has no mark, and joins the column of the same meaning that has one
            same = next((kept for kept in new if _alike(kept) == _alike(column)), column)
            place = new.setdefault(same, []) if other == table else again.setdefault(f"as in {other}:", [])
            place.append(f"`{column.path}`")
        lines += [f"- {', '.join(paths)} ({_facts(column)}): {column.meaning}" for column, paths in new.items()]
        lines += [f"- {where} {', '.join(paths)}" for where, paths in again.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(write_page(), end="")
