"""`verso query`: SQL over the manifests of a dataset, finished or being made. Reads nothing else and writes nothing."""

import contextlib
import urllib.parse
import warnings
from collections.abc import Iterable, Mapping
from itertools import groupby
from typing import Any, TypeAlias

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import COMMITS, MANIFEST, STAGING, SUCCESS_FILE, range_name, range_table_path
from schemas.dataset.tables import CAPTURE_SCHEMAS, SCHEMAS, TABLES, schema_of
from schemas.errors import CorruptError, InputError, OutputError
from services.job.record import read_job
from services.merge.step import read_success
from services.read.damage import explain_damage
from workers.store.commit import commit_names, read_record
from workers.store.committed_rows import range_rows
from workers.store.manifest import join_rows
from workers.store.store import Store

_LOCKED = {
    "enable_external_access": "false",
    "python_enable_replacements": "false",
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
}
"""SQL sees the six tables and no file, no network, no variable of this process."""

_NO_QUESTION = 'there is no question: write SQL, for example "select category, count(*) from scenes group by 1"'

Rows: TypeAlias = ds.Dataset | pa.Table

_FORMAT = ds.ParquetFileFormat(
    default_fragment_scan_options=ds.ParquetFragmentScanOptions(page_checksum_verification=True)
)


def query(store: Store, sql: str) -> pa.Table:
    """The result of one SQL query over the tables scenes, views, objects, assets, failures and timings.

    A finished dataset is read from its merged tables, an unfinished one through its commits, where a retry's rows replace
    the first try's. Raises InputError with the database's message where the SQL is wrong, OutputError where there is no
    dataset, CorruptError where a file is damaged.
    """
    with explain_damage(store), duckdb.connect(":memory:", config=dict(_LOCKED)) as connection:
        _register(connection, store)
        connection.execute("SET lock_configuration = true")
        try:
            if not connection.extract_statements(sql):
                raise InputError(_NO_QUESTION)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that a copy is made
                return connection.execute(sql).to_arrow_table()
        except duckdb.Error as error:
            line = str(error).splitlines()[0]
            if "orrupt" in line or "CRC" in line or "thrift" in line.lower():
                raise CorruptError(f"{line}; `verso verify` lists every damaged file") from error
            raise InputError(f"the query failed: {line}") from error


def _register(connection: duckdb.DuckDBPyConnection, store: Store) -> None:
    """Make a view of each table."""
    done = read_success(store)
    committed = _Committed(store) if done is None else None
    schemas = _schemas(store)
    for table in TABLES:
        schema = schemas[table]
        parts = (
            committed.parts(table, schema) if committed else _merged(store, _merged_files(store, done), table, schema)
        )
        for number, part in enumerate(parts):
            connection.register(f"_{table}_{number}", part)
        columns = ", ".join(f'"{name}"' for name in schema.names)
        union = " UNION ALL ".join(f"SELECT {columns} FROM _{table}_{number}" for number in range(len(parts)))
        once = "DISTINCT ON (instance_id)" if table == "assets" else ""
        connection.execute(f"CREATE VIEW {table} AS SELECT {once} {columns} FROM ({union})")


def _schemas(store: Store) -> Mapping[str, pa.Schema]:
    """The schemas of the tables: by job.yaml those of scenes or of captures."""
    with contextlib.suppress(CorruptError):  # the tables can be asked without it
        record = read_job(store)
        if record is not None and record.job.captures is not None:
            return CAPTURE_SCHEMAS
    return SCHEMAS


def _merged_files(store: Store, success: Mapping[str, Any] | None) -> list[str]:
    """The merged files that `_SUCCESS` names. Raises CorruptError where it does not name a file of each table."""
    files = (success or {}).get("files")
    if isinstance(files, dict) and all(
        any(key.startswith(f"{MANIFEST}/{table}/") for key in files) for table in TABLES
    ):
        return list(files)
    told = f"{SUCCESS_FILE} in {store.name} does not name its merged files"
    raise CorruptError(f"{told}: `verso replay {store.name} --repair` writes it again")


def _merged(store: Store, keys: Iterable[str], table: str, schema: pa.Schema) -> list[Rows]:
    """The merged table: read lazily from a disk, as a whole from an object store."""
    folder = f"{MANIFEST}/{table}"
    keys = [key for key in keys if key.startswith(f"{folder}/")]
    if store.root is None:
        return [join_rows(table, [schema.empty_table(), *(read_merged(table, key, store.read(key)) for key in keys)])]
    partitioning = ds.partitioning(pa.schema([("category", pa.string())]), flavor="hive")
    paths, base = [str(store.root / key) for key in keys], str(store.root / folder)
    return [ds.dataset(paths, schema, _FORMAT, partitioning=partitioning, partition_base_dir=base)]


def read_merged(table: str, key: str, data: bytes) -> pa.Table:
    """The rows in the bytes of one merged file, with the category that its folder names."""
    rows = pq.read_table(pa.BufferReader(data), page_checksum_verification=True)
    category = urllib.parse.unquote(key.split("/")[-2].removeprefix("category="))
    column = pa.repeat(pa.scalar(category), rows.num_rows)
    schema = schema_of(table, rows.column_names)
    return rows.append_column("category", column).select(schema.names).cast(schema)


class _Committed:
    """Committed rows: files in place, and rows in memory for ranges that are not published or have retries."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._plain: list[int] = []
        self._other: list[list[CommitRecord]] = []
        names = commit_names(store)
        if not names:
            raise OutputError(f"{store.name} holds no dataset that can be asked: there is nothing in {COMMITS} yet")
        # Listed after the commits: a committed range without staging is published.
        staged = set(store.children(STAGING))
        for start, group in groupby(names, key=lambda name: name[0]):
            retries = [retry for _, retry, _ in group]
            if store.root is not None and retries == [0] and range_name(start) not in staged:
                self._plain.append(start)
            else:
                records = [record for retry in retries if (record := read_record(store, start, retry)) is not None]
                self._other.append(records)

    def parts(self, table: str, schema: pa.Schema) -> list[Rows]:
        """The rows of one table: those in memory, and those in files."""
        rows = [range_rows(self._store, records, table) for records in self._other]
        parts: list[Rows] = [join_rows(table, [schema.empty_table(), *rows])]
        if self._plain and self._store.root is not None:
            paths = [str(self._store.root / range_table_path(start, table)) for start in self._plain]
            parts.append(ds.dataset(paths, schema, _FORMAT))
        return parts
