"""The merged manifest tables: rows in order, split by category, in files of about 100,000 rows."""

from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from schemas.dataset.layout import merged_table_path
from schemas.dataset.tables import SCHEMAS, SORT_KEYS, schema_of
from schemas.errors import CorruptError
from workers.store.canonical import TableDigest
from workers.store.manifest import PARQUET_OPTIONS

ROWS_PER_FILE = 100_000
ROWS_PER_GROUP = 8_192
"""Rows of a Parquet row group; also how many rows of a table wait before they are split by category."""
WAITING_BYTES = 24 << 20
"""Memory for the rows of one table that wait, before they are split and behind that in all categories together."""


class MergedTable:
    """Writes one table below `folder` as hive partitions, and digests its rows."""

    def __init__(self, table: str, folder: Path) -> None:
        self.table = table
        self.digest = TableDigest(table)
        self._folder = folder
        self._parts: dict[str, _Parts] = {}
        self._unsplit: list[pa.Table] = []
        self._unsplit_bytes = 0
        self._last_row: pa.Table | None = None

    def add(self, rows: pa.Table) -> None:
        """Takes the next rows, best some thousands, sorted by key. Raises CorruptError where a key does not rise."""
        if not rows.num_rows:
            return
        rows = rows.combine_chunks()
        self._check_order(rows)
        self.digest.update(rows)
        self._unsplit.append(rows)
        self._unsplit_bytes += rows.nbytes
        if self._unsplit_bytes >= WAITING_BYTES // 2 or sum(map(len, self._unsplit)) >= ROWS_PER_GROUP:
            self._split()

    def finish(self, categories: list[str]) -> dict[str, Path]:
        """The finished files by key. An empty table gets one empty file under the first of `categories`."""
        self._split()
        if not self._parts:
            self._parts_of(categories[0]).write(SCHEMAS[self.table].empty_table())
        return {key: path for parts in self._parts.values() for key, path in parts.finish().items()}

    @property
    def categories(self) -> set[str]:
        """Those that have rows so far."""
        self._split()
        return set(self._parts)

    def _split(self) -> None:
        """Gives the rows to their categories; where those hold too much then, the largest write theirs."""
        if not self._unsplit:
            return
        rows = pa.concat_tables(self._unsplit)
        self._unsplit, self._unsplit_bytes = [], 0
        column = rows.column("category")
        for category in sorted(column.unique().to_pylist()):
            self._parts_of(category).write(rows.filter(pc.equal(column, category)))
        while sum(parts.waiting_bytes for parts in self._parts.values()) > WAITING_BYTES // 2:
            max(self._parts.values(), key=lambda parts: parts.waiting_bytes).flush()

    def _parts_of(self, category: str) -> "_Parts":
        if category not in self._parts:
            self._parts[category] = _Parts(self.table, category, self._folder)
        return self._parts[category]

    def _check_order(self, rows: pa.Table) -> None:
        """Compares each row with the one before it, column by column of the key."""
        keys = rows.select(SORT_KEYS[self.table])
        if self._last_row is not None:
            keys = pa.concat_tables([self._last_row, keys]).combine_chunks()
        rises = pa.array(np.zeros(len(keys) - 1, bool))
        for column in reversed(keys.columns):
            before, after = column.slice(0, len(keys) - 1), column.slice(1)
            rises = pc.or_(pc.less(before, after), pc.and_(pc.equal(before, after), rises))
        if (at := pc.index(rises, False).as_py()) >= 0:
            before, after = (tuple(keys.slice(at + i, 1).to_pylist()[0].values()) for i in (0, 1))
            raise CorruptError(
                f"{self.table}: the key ({', '.join(keys.column_names)}) = {after} comes after {before}: "
                "the ranges do not join; `verso verify` lists what is damaged"
            )
        self._last_row = keys.take([len(keys) - 1])


class _Parts:
    """The files of one category of one table."""

    def __init__(self, table: str, category: str, folder: Path) -> None:
        self._table = table
        self._category = category
        self._folder = folder
        self._schema: pa.Schema | None = None
        self._waiting: list[pa.Table] = []
        self.waiting_bytes = 0
        self._writer: pq.ParquetWriter | None = None
        self._sink = _Sink()
        self._file_rows = 0
        self._files: dict[str, Path] = {}

    def write(self, rows: pa.Table) -> None:
        """Takes the next rows; the first ones decide whether the files are of scenes or of captures."""
        self._waiting.append(rows.drop_columns("category"))
        if self._schema is None:
            schema = schema_of(self._table, rows.column_names)
            self._schema = schema.remove(schema.get_field_index("category"))
        self.waiting_bytes += self._waiting[-1].nbytes
        if sum(map(len, self._waiting)) >= ROWS_PER_GROUP:
            self.flush()

    def finish(self) -> dict[str, Path]:
        """Ends the last file; the files by key."""
        if self._waiting or not self._files:
            self.flush()
        self._end_file()
        return self._files

    def flush(self) -> None:
        """Writes the rows that wait."""
        assert self._schema is not None
        rows = pa.concat_tables([self._schema.empty_table(), *self._waiting])
        self._waiting, self.waiting_bytes = [], 0
        while rows.num_rows or not self._files:
            piece = rows.slice(0, ROWS_PER_FILE - self._file_rows)
            self._open().write_table(piece, row_group_size=ROWS_PER_GROUP)
            self._store()
            self._file_rows += piece.num_rows
            rows = rows.slice(piece.num_rows)
            if self._file_rows >= ROWS_PER_FILE:
                self._end_file()

    def _open(self) -> pq.ParquetWriter:
        if self._writer is None:
            key = merged_table_path(self._table, self._category, len(self._files))
            self._files[key] = self._folder / key
            self._files[key].parent.mkdir(parents=True, exist_ok=True)
            self._sink = _Sink()
            self._writer = pq.ParquetWriter(pa.PythonFile(self._sink, mode="w"), self._schema, **PARQUET_OPTIONS)
        return self._writer

    def _end_file(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._store()
            self._writer, self._file_rows = None, 0

    def _store(self) -> None:
        """Appends what the writer wrote to the file on the disk, which is open only meanwhile."""
        with open(list(self._files.values())[-1], "ab") as file:
            self._sink.drain(file)


class _Sink:
    """Where a Parquet writer writes to: memory, so that it never fails and hundreds of files need not be open at once."""

    def __init__(self) -> None:
        self.closed = False
        self._position = 0
        self._pending: list[bytes] = []

    def write(self, data: bytes | pa.Buffer) -> int:
        """Takes the next bytes."""
        self._pending.append(bytes(memoryview(data)))
        self._position += len(self._pending[-1])
        return len(self._pending[-1])

    def tell(self) -> int:
        """Bytes so far."""
        return self._position

    def flush(self) -> None:
        """Does nothing."""

    def close(self) -> None:
        """Takes no more bytes."""
        self.closed = True

    def drain(self, file: IO[bytes]) -> None:
        """Moves the bytes since the last call to a file."""
        pending, self._pending = self._pending, []
        file.writelines(pending)
