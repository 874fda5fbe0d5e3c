"""The tables of one range: checked against their schema, sorted by key, encoded as Parquet and decoded."""

import io
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.tables import SCHEMAS, SORT_KEYS
from schemas.errors import CorruptError

PARQUET_OPTIONS = {"compression": "zstd", "write_page_checksum": True}
"""For every Parquet file of a dataset: a flipped bit is found when the page is read."""


def table_of_rows(table: str, rows: Sequence[Mapping[str, object]]) -> pa.Table:
    """Rows as an Arrow table with exactly the schema of `table`.

    Raises ValueError naming the table and the column where a key is unknown or missing, a value has the wrong type, a
    required one is absent or a number is not finite.
    """
    schema = SCHEMAS[table]
    if not rows:
        return schema.empty_table()
    names = set(schema.names)
    for row in rows:
        if row.keys() != names:
            wrong = sorted(names.symmetric_difference(row.keys()))
            raise ValueError(f"{table}: a row has other columns than the schema: {', '.join(wrong)}")
    arrays = []
    for field in schema:
        where = f"{table}.{field.name}"
        try:
            array = pa.array([row[field.name] for row in rows], field.type)
        except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError) as error:
            raise ValueError(f"{where}: {error}") from error
        _check_values(where, field, array)
        arrays.append(array)
    return pa.Table.from_arrays(arrays, schema=schema)


def sorted_rows(table: str, rows: pa.Table) -> pa.Table:
    """Rows in the order of the table's key. Raises ValueError where two rows share a key."""
    names = SORT_KEYS[table]
    result = rows.sort_by([(name, "ascending") for name in names])
    for key, following in pairwise(zip(*(result.column(name).to_pylist() for name in names), strict=True)):
        if key == following:
            raise ValueError(f"{table}: two rows have the key {', '.join(names)} = {', '.join(map(str, key))}")
    return result


def encode_table(rows: pa.Table) -> bytes:
    """Parquet bytes with a checksum on each page; the schema's metadata name the table and the schema version."""
    sink = io.BytesIO()
    pq.write_table(rows, sink, **PARQUET_OPTIONS)
    return sink.getvalue()


def decode_table(table: str, data: bytes, name: str) -> pa.Table:
    """The rows of a range's Parquet bytes, in today's schema: columns added since they were written are null.

    Raises CorruptError naming the file where a page fails its checksum, the file is torn, or it is another table.
    """
    try:
        with pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True) as file:
            return conform(table, file.read(), name)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CorruptError(f"{name} cannot be read: {error}; `verso verify` lists every damaged file") from error


def conform(table: str, rows: pa.Table, name: str) -> pa.Table:
    """Rows with exactly today's schema of `table`. Raises CorruptError where a required column is missing.

    A schema only grows. So rows that lack a column and have an unknown one have a damaged column name.
    """
    schema = SCHEMAS[table]
    if rows.schema.equals(schema):
        return rows.cast(schema)  # Parquet has other names inside lists
    missing = [column for column in schema.names if column not in rows.column_names]
    foreign = [column for column in rows.column_names if column not in schema.names]
    if missing and foreign:
        raise CorruptError(f"{name} lacks the column {missing[0]} of the table {table}, and has {foreign[0]!r}")
    columns = []
    for field in schema:
        if field.name in rows.column_names:
            columns.append(rows.column(field.name).cast(field.type))
        elif field.nullable:
            columns.append(pa.chunked_array([pa.nulls(rows.num_rows, field.type)]))
        else:
            raise CorruptError(f"{name} lacks the column {field.name} of the table {table}")
    return pa.Table.from_arrays(columns, schema=schema)


def _check_values(where: str, field: pa.Field, array: pa.Array) -> None:
    """Raises ValueError for an absent value that the schema requires, or a double that is not finite, at any depth."""
    if not field.nullable and array.null_count:
        raise ValueError(f"{where} is missing in {array.null_count} of {len(array)} rows")
    kind = field.type
    if pa.types.is_floating(kind):
        values = array.drop_null().to_numpy()
        if not np.isfinite(values).all():
            raise ValueError(f"{where} is not finite: {values[~np.isfinite(values)][0]}")
    elif pa.types.is_struct(kind):
        present = array.drop_null()
        for i in range(kind.num_fields):
            _check_values(f"{where}.{kind.field(i).name}", kind.field(i), present.field(i))
    elif pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        _check_values(where, kind.value_field, array.flatten())
