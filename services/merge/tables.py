"""The merged manifest tables: rows in order, split by category, in files of about 100,000 rows."""

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from schemas.dataset.layout import merged_table_path
from schemas.dataset.tables import SCHEMAS, SORT_KEYS
from schemas.errors import CorruptError
from workers.store.canonical import TableDigest
from workers.store.manifest import PARQUET_OPTIONS

ROWS_PER_FILE = 100_000
ROWS_PER_GROUP = 8_192
"""Rows of a Parquet row group; also how many rows of one category wait in memory."""
ROWS_PER_BLOCK = 2_048
"""Rows are checked, digested and split in blocks of this size: small enough for memory, large enough to be fast."""


class MergedTable:
    """Writes one table below `folder` as hive partitions, and digests its rows."""

    def __init__(self, table: str, folder: Path) -> None:
        self.table = table
        self.digest = TableDigest(table)
        self._folder = folder
        self._parts: dict[str, _Parts] = {}
        self._block: list[pa.Table] = []
        self._last_key: tuple[object, ...] | None = None

    def add(self, rows: pa.Table) -> None:
        """Takes the next rows, sorted by key. Raises CorruptError where a key is repeated or out of order."""
        self._block.append(rows)
        if sum(part.num_rows for part in self._block) >= ROWS_PER_BLOCK:
            self._flush()

    def finish(self, categories: list[str]) -> dict[str, Path]:
        """The finished files by key. An empty table gets one empty file under the first of `categories`."""
        self._flush()
        if not self._parts:
            self._parts_of(categories[0]).write(SCHEMAS[self.table].empty_table())
        return {key: path for parts in self._parts.values() for key, path in parts.finish().items()}

    def close(self) -> None:
        """Closes every file, finished or not."""
        for parts in self._parts.values():
            parts.close()

    @property
    def categories(self) -> set[str]:
        """Those that have rows so far."""
        self._flush()
        return set(self._parts)

    def _flush(self) -> None:
        rows = pa.concat_tables([SCHEMAS[self.table].empty_table(), *self._block]).combine_chunks()
        self._block = []
        self._check_order(rows)
        self.digest.update(rows)
        column = rows.column("category")
        for category in sorted(column.unique().to_pylist()):
            self._parts_of(category).write(rows.filter(pc.equal(column, category)))

    def _parts_of(self, category: str) -> "_Parts":
        if category not in self._parts:
            self._parts[category] = _Parts(self.table, category, self._folder)
        return self._parts[category]

    def _check_order(self, rows: pa.Table) -> None:
        names = SORT_KEYS[self.table]
        for key in zip(*(rows.column(name).to_pylist() for name in names), strict=True):
            if self._last_key is not None and not self._last_key < key:
                raise CorruptError(
                    f"{self.table}: the key ({', '.join(names)}) = {key} comes after {self._last_key}: "
                    "the ranges do not join; `verso verify` lists what is damaged"
                )
            self._last_key = key


class _Parts:
    """The files of one category of one table."""

    def __init__(self, table: str, category: str, folder: Path) -> None:
        self._table = table
        self._category = category
        self._folder = folder
        schema = SCHEMAS[table]
        self._schema = schema.remove(schema.get_field_index("category"))
        self._waiting = self._schema.empty_table()
        self._file: pq.ParquetWriter | None = None
        self._file_rows = 0
        self._files: dict[str, Path] = {}

    def write(self, rows: pa.Table) -> None:
        """Takes the next rows."""
        self._waiting = pa.concat_tables([self._waiting, rows.drop_columns("category")])
        if self._waiting.num_rows >= ROWS_PER_GROUP:
            self._flush()

    def finish(self) -> dict[str, Path]:
        """Closes the last file; the files by key."""
        if self._waiting.num_rows or not self._files:
            self._flush()
        self.close()
        return self._files

    def close(self) -> None:
        """Closes the open file."""
        if self._file is not None:
            self._file.close()
            self._file, self._file_rows = None, 0

    def _flush(self) -> None:
        rows, self._waiting = self._waiting.combine_chunks(), self._schema.empty_table()
        while rows.num_rows or not self._files:
            writer = self._open()
            piece = rows.slice(0, ROWS_PER_FILE - self._file_rows)
            writer.write_table(piece, row_group_size=ROWS_PER_GROUP)
            self._file_rows += piece.num_rows
            rows = rows.slice(piece.num_rows)
            if self._file_rows >= ROWS_PER_FILE:
                self.close()

    def _open(self) -> pq.ParquetWriter:
        if self._file is None:
            key = merged_table_path(self._table, self._category, len(self._files))
            self._files[key] = self._folder / key
            self._files[key].parent.mkdir(parents=True, exist_ok=True)
            self._file = pq.ParquetWriter(self._files[key], self._schema, **PARQUET_OPTIONS)
        return self._file
