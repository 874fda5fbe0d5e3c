"""`verso query`: SQL over the manifests of a dataset, finished or being made. Reads nothing else and writes nothing."""

import csv
import io
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import IO, BinaryIO, Literal, TextIO, cast

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import CorruptError, InputError, VersoError
from services.read.dataset_reader import StoredTables
from services.read.verdict import explain_damage
from workers.store.store import Store

LOCKED = {
    "enable_external_access": "false",
    "python_enable_replacements": "false",
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
}
"""SQL sees the six tables and no file, no network, no variable of this process."""

_NO_QUESTION = 'there is no question: write SQL, for example "select category, count(*) from scenes group by 1"'

_DATABASE_SAYS = re.compile(r"[A-Z]\w+( \w+)* Error: ")
"""Begins what the database says while its answer is read: pyarrow makes an OSError of it."""

BATCH_ROWS = 4096
"""Rows of a batch of the answer: some megabytes of the widest table."""


@contextmanager
def ask(source: Store | StoredTables, sql: str) -> Iterator[pa.RecordBatchReader]:
    """The result of one SQL query over the tables scenes, views, objects, assets, failures and timings, as it comes.

    A finished dataset is read from its merged tables, an unfinished one through its commits, where a retry's rows replace
    the first try's. Raises, also while the reader is read, InputError with the database's message where the SQL is wrong,
    OutputError where there is no dataset, CorruptError where a file is damaged.
    """
    store = source.store if isinstance(source, StoredTables) else source
    with duckdb.connect(":memory:", config=dict(LOCKED)) as connection:
        with _explained(store):
            _register(connection, source if isinstance(source, StoredTables) else StoredTables(source))
            connection.execute("SET enable_progress_bar = false")  # it goes to standard output, into the answer
            connection.execute("SET lock_configuration = true")
            if not connection.extract_statements(sql):
                raise InputError(_NO_QUESTION)
            shown = sql.strip().rstrip("; ").lower() == "show tables"
            relation = connection.sql(_SHOW_TABLES if shown else sql)  # `execute` would keep the whole answer
            if relation is None:
                raise InputError("the statement answers nothing: ask with `select`")
            answer = relation.to_arrow_reader(BATCH_ROWS)
        yield pa.RecordBatchReader.from_batches(answer.schema, _batches(store, answer))


_SHOW_TABLES = (
    "select table_name as name from information_schema.tables where table_name not like '\\_%' escape '\\' order by 1"
)
"""`show tables`, without the views that tables are put together from."""


def query(source: Store | StoredTables, sql: str) -> pa.Table:
    """The whole result of `ask`."""
    with ask(source, sql) as answer:
        return answer.read_all()


def _batches(store: Store, answer: pa.RecordBatchReader) -> Iterator[pa.RecordBatch]:
    while True:
        with _explained(store):
            try:
                batch = answer.read_next_batch()
            except StopIteration:
                return
        yield batch


@contextmanager
def _explained(store: Store) -> Iterator[None]:
    """Raises what the database says as InputError, or as CorruptError where it met a damaged file."""
    with explain_damage(store):
        try:
            yield
        except VersoError:
            raise
        except (duckdb.Error, pa.ArrowException, OSError) as error:
            line, *more = str(error).splitlines()
            line += "".join(f"; {words}" for words in more if words.startswith(("Did you mean", "Candidate")))
            if "orrupt" in line or "CRC" in line or "thrift" in line.lower():
                raise CorruptError(f"{line}; `verso verify OUT` lists every damaged file") from error
            if not isinstance(error, duckdb.Error) and not _DATABASE_SAYS.match(line):
                raise
            raise InputError(f"the query failed: {line}") from error


def _register(connection: duckdb.DuckDBPyConnection, tables: StoredTables) -> None:
    """Make a view of each table."""
    for table in TABLES:
        parts = tables.parts(table)
        for number, part in enumerate(parts):
            connection.register(f"_{table}_{number}", part)
        columns = ", ".join(f'"{name}"' for name in SCHEMAS[table].names)
        union = " UNION ALL ".join(f"SELECT {columns} FROM _{table}_{number}" for number in range(len(parts)))
        once = "DISTINCT ON (instance_id)" if table == "assets" else ""
        connection.execute(f"CREATE VIEW {table} AS SELECT {once} {columns} FROM ({union})")


Format = Literal["table", "csv", "parquet", "json"]

_SHOWN_OF = 10_000
"""DuckDB counts so many rows for a box; of more it says that there are more."""

_ALL_COLUMNS = 100_000
"""Characters of a line where no terminal bounds it."""

_ROW_GROUP_BYTES = 4 << 20
"""Bytes in memory of a row group of the Parquet format."""


def write_rows(rows: pa.RecordBatchReader, style: Format, sink: IO[bytes], wide: int | None = None) -> None:
    """Writes the rows in one of four formats, a batch in memory at a time.

    A list or struct is JSON in a cell of CSV; the JSON format is one array of objects. A table is DuckDB's box, with its first
    and last rows where there are many, and as many columns as `wide` characters have room for (None: all of them).
    """
    if style == "table":
        sink.write(_box(rows, wide).encode())
        return
    if style == "parquet":
        with pq.ParquetWriter(pa.PythonFile(sink, mode="w"), rows.schema, compression="zstd") as writer:
            for group in _row_groups(rows):
                writer.write_table(group)
        return
    text = io.TextIOWrapper(cast(BinaryIO, sink), "utf-8", newline="")
    try:
        (_write_json if style == "json" else _write_csv)(rows, text)
    finally:
        text.detach()  # else it would close the sink


def _row_groups(rows: pa.RecordBatchReader) -> Iterator[pa.Table]:
    """The rows in tables of about `_ROW_GROUP_BYTES`: the writer keeps a row group until it is whole."""
    kept: list[pa.RecordBatch] = []
    for batch in rows:
        kept.append(batch)
        if sum(rows.nbytes for rows in kept) >= _ROW_GROUP_BYTES:
            yield pa.Table.from_batches(kept)
            kept = []
    if kept:
        yield pa.Table.from_batches(kept)


def _records(rows: pa.RecordBatchReader) -> Iterator[tuple[object, ...]]:
    for batch in rows:
        yield from zip(*(column.to_pylist() for column in batch.columns), strict=True)


def _cell(value: object) -> str:
    if value is None:
        return ""
    return json.dumps(value, default=str) if isinstance(value, list | dict | bool) else str(value)


def _write_json(rows: pa.RecordBatchReader, text: TextIO) -> None:
    before = "["
    for record in _records(rows):
        text.write(before + json.dumps(dict(zip(rows.schema.names, record, strict=True)), default=str))
        before = ", "
    text.write("]\n" if before != "[" else "[]\n")


def _write_csv(rows: pa.RecordBatchReader, text: TextIO) -> None:
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(rows.schema.names)
    writer.writerows(map(_cell, record) for record in _records(rows))


def _box(rows: pa.RecordBatchReader, wide: int | None) -> str:
    kept: list[pa.RecordBatch] = []
    for batch in rows:
        kept.append(batch)
        if sum(rows.num_rows for rows in kept) > _SHOWN_OF:
            break
    shown = io.StringIO()
    with duckdb.connect(":memory:") as connection, redirect_stdout(shown):
        connection.from_arrow(pa.Table.from_batches(kept, rows.schema)).show(max_width=wide or _ALL_COLUMNS)
    return shown.getvalue()
