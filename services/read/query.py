"""`verso query`: SQL over the manifests of a dataset, finished or being made. Reads nothing else and writes nothing."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import duckdb
import pyarrow as pa

from schemas.dataset.tables import TABLES
from schemas.errors import CorruptError, InputError, VersoError
from services.read.damage import explain_damage
from services.read.stored_tables import StoredTables
from workers.store.store import Store

_LOCKED = {
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
def ask(store: Store, sql: str) -> Iterator[pa.RecordBatchReader]:
    """The result of one SQL query over the tables scenes, views, objects, assets, failures and timings, as it comes.

    A finished dataset is read from its merged tables, an unfinished one through its commits, where a retry's rows replace
    the first try's. Raises, also while the reader is read, InputError with the database's message where the SQL is wrong,
    OutputError where there is no dataset, CorruptError where a file is damaged.
    """
    with duckdb.connect(":memory:", config=dict(_LOCKED)) as connection:
        with _explained(store):
            _register(connection, store)
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


def query(store: Store, sql: str) -> pa.Table:
    """The whole result of `ask`."""
    with ask(store, sql) as answer:
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
                raise CorruptError(f"{line}; `verso verify` lists every damaged file") from error
            if not isinstance(error, duckdb.Error) and not _DATABASE_SAYS.match(line):
                raise
            raise InputError(f"the query failed: {line}") from error


def _register(connection: duckdb.DuckDBPyConnection, store: Store) -> None:
    """Make a view of each table."""
    tables = StoredTables(store)
    for table in TABLES:
        parts = tables.parts(table)
        for number, part in enumerate(parts):
            connection.register(f"_{table}_{number}", part)
        columns = ", ".join(f'"{name}"' for name in tables.schemas[table].names)
        union = " UNION ALL ".join(f"SELECT {columns} FROM _{table}_{number}" for number in range(len(parts)))
        once = "DISTINCT ON (instance_id)" if table == "assets" else ""
        connection.execute(f"CREATE VIEW {table} AS SELECT {once} {columns} FROM ({union})")
