"""Writes docs/columns.md and what `verso columns` prints: every column of every table, from the schemas."""

import dataclasses
import textwrap
from typing import Any

from schemas.dataset.columns import FRAMES, TABLE_MEANINGS, Column, columns_of, key_of
from schemas.dataset.tables import TABLES
from schemas.errors import InputError, did_you_mean

WIDTH = 100
"""Columns of a terminal that meanings are wrapped to."""

HEADER = """\
# Columns of the tables

Written from `schemas/dataset/` by `python -m services.read.columns_page`; a test holds the two together. `verso columns TABLE`
prints the same.

A column name ends in its unit where it has one: `_m` metres, `_mm` millimetres, `_rad` radians, `_deg` degrees, `_s` seconds.
Below, `1` is a pure number, `id` and `count` are whole numbers. `T_a_b` takes coordinates in frame b to coordinates in frame a:
16 doubles, row by row. `name[]` stands for the items of a list. "or null" says that a value may be missing; columns marked
"captures" are there in datasets of captures alone, where whatever tells of a simulated rest is null.

Frames:

"""


def list_columns(table: str | None) -> list[dict[str, Any]]:
    """Every column of one table, or of all, for programs. Raises InputError for a table that is not."""
    return [_plain(column) for name in _chosen(table) for column in columns_of(name)]


def _plain(column: Column) -> dict[str, Any]:
    meaning = column.meaning
    return {**dataclasses.asdict(column), "meaning": meaning.text, "unit": meaning.unit, "frame": meaning.frame}


def _chosen(table: str | None) -> tuple[str, ...]:
    if table is not None and table not in TABLES:
        raise InputError(f"there is no table {table!r}; {did_you_mean(table, TABLES)}Tables are {', '.join(TABLES)}")
    return (table,) if table else TABLES


def describe_columns(table: str | None) -> list[str]:
    """The lines that `verso columns` prints. Raises InputError for a table that is not."""
    lines = []
    for name in _chosen(table):
        lines += [f"{name}: {TABLE_MEANINGS[name]}", f"  key: {', '.join(key_of(name))}"]
        for column in columns_of(name):
            lines.append(f"  {column.path}  ({_facts(column)})")
            lines += textwrap.wrap(column.meaning.text, WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
        lines.append("")
    return lines[:-1]


def _facts(column: Column) -> str:
    """Type, unit and frame in a few words."""
    meaning = column.meaning
    words = [f"{column.type}{' or null' if column.nullable else ''}", meaning.unit]
    words += [f"frame: {' from '.join(meaning.frame.split(', '))}" if meaning.frame else ""]
    return ", ".join(word for word in [*words, "captures" if column.captures_only else ""] if word)


def write_page() -> str:
    """The text of docs/columns.md."""
    lines = [HEADER + "\n".join(f"- **{name}**: {text}" for name, text in FRAMES.items())]
    for table in TABLES:
        lines += [
            "",
            f"## {table}",
            "",
            f"{TABLE_MEANINGS[table]} Key: {', '.join(f'`{one}`' for one in key_of(table))}.",
            "",
        ]
        lines += ["| column | type | unit | frame | meaning |", "|---|---|---|---|---|"]
        lines += [_row(column) for column in columns_of(table)]
    return "\n".join(lines) + "\n"


def _row(column: Column) -> str:
    meaning = column.meaning
    kind = column.type + (" or null" if column.nullable else "") + (" (captures)" if column.captures_only else "")
    frame = " from ".join(meaning.frame.split(", "))
    return f"| `{column.path}` | {kind} | {meaning.unit} | {frame} | {meaning.text} |"


if __name__ == "__main__":
    print(write_page(), end="")
