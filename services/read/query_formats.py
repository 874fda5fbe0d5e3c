"""Query results as a table for people, or as CSV, JSON or Parquet for programs."""

import csv
import io
import json
from typing import Literal

import pyarrow as pa
import pyarrow.parquet as pq

Format = Literal["table", "csv", "parquet", "json"]

_WIDEST_CELL = 60
"""Characters; longer cells are cut in the table for people alone."""


def format_rows(rows: pa.Table, style: Format) -> bytes:
    """The rows in one of four formats. A list or struct is JSON in its cell; the JSON format is one array of objects."""
    if style == "parquet":
        sink = io.BytesIO()
        pq.write_table(rows, sink, compression="zstd")
        return sink.getvalue()
    records = list(zip(*(column.to_pylist() for column in rows.columns), strict=True))
    if style == "json":
        named = [dict(zip(rows.column_names, record, strict=True)) for record in records]
        return (json.dumps(named, default=str) + "\n").encode()
    cells = [[_cell(value) for value in record] for record in records]
    return (_csv(rows.column_names, cells) if style == "csv" else _table(rows, cells)).encode()


def _cell(value: object) -> str:
    if value is None:
        return ""
    return json.dumps(value, default=str) if isinstance(value, list | dict | bool) else str(value)


def _table(rows: pa.Table, cells: list[list[str]]) -> str:
    cells = [[_cut(cell.replace("\n", " ")) for cell in record] for record in cells]
    widths = [max(map(len, column)) for column in zip(rows.column_names, *cells, strict=True)]
    numeric = [pa.types.is_integer(kind) or pa.types.is_floating(kind) for kind in rows.schema.types]
    signs = [f"{'>' if right else '<'}{width}" for right, width in zip(numeric, widths, strict=True)]
    lines = [
        "  ".join(map(format, record, signs)).rstrip()
        for record in (rows.column_names, ["-" * width for width in widths], *cells)
    ]
    return "\n".join([*lines, f"({rows.num_rows} row{'' if rows.num_rows == 1 else 's'})", ""])


def _cut(text: str) -> str:
    return text if len(text) <= _WIDEST_CELL else text[: _WIDEST_CELL - 1] + "…"


def _csv(names: list[str], cells: list[list[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *cells])
    return text.getvalue()
