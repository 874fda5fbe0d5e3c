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
    writers = {"table": _table, "csv": _csv, "json": _json}
    return writers[style](rows).encode()


def _records(rows: pa.Table) -> list[list[object]]:
    columns = [column.to_pylist() for column in rows.columns]
    return [list(record) for record in zip(*columns, strict=True)]


def _cell(value: object) -> str:
    if value is None:
        return ""
    return json.dumps(value, default=str) if isinstance(value, list | dict | bool) else str(value)


def _table(rows: pa.Table) -> str:
    cells = [[_cut(_cell(value)) for value in record] for record in _records(rows)]
    numeric = [pa.types.is_integer(kind) or pa.types.is_floating(kind) for kind in rows.schema.types]
    widths = [max(map(len, column)) for column in zip(rows.column_names, *cells, strict=True)]
    lines = [_line(rows.column_names, widths, numeric), "  ".join("-" * width for width in widths)]
    lines += [_line(record, widths, numeric) for record in cells]
    return "\n".join([*lines, f"({rows.num_rows} row{'' if rows.num_rows == 1 else 's'})", ""])


def _cut(text: str) -> str:
    text = text.replace("\n", " ")
    return text if len(text) <= _WIDEST_CELL else text[: _WIDEST_CELL - 1] + "…"


def _line(cells: list[str], widths: list[int], numeric: list[bool]) -> str:
    padded = [c.rjust(w) if right else c.ljust(w) for c, w, right in zip(cells, widths, numeric, strict=True)]
    return "  ".join(padded).rstrip()


def _csv(rows: pa.Table) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(rows.column_names)
    writer.writerows([_cell(value) for value in record] for record in _records(rows))
    return text.getvalue()


def _json(rows: pa.Table) -> str:
    records = [dict(zip(rows.column_names, record, strict=True)) for record in _records(rows)]
    return json.dumps(records, default=str) + "\n"
