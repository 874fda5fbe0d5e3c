"""Reading of committed ranges for the merge, in blocks whose rows are joined, and the check that their files are published."""

import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.commit import CommitRecord, FileEntry, Span
from schemas.dataset.layout import RANGES, is_range_file, is_shape, pose_of_image, range_table_path
from schemas.dataset.tables import SCHEMAS, SHAPE_FILE_COLUMNS, TABLES
from schemas.errors import CorruptError
from services.merge.shared import explain_full_disk, open_scratch
from workers.store.commit import committed_files, read_range_file
from workers.store.ledger import iter_ranges, range_rows
from workers.store.manifest import conform, decode_rows, files_of_assets, join_rows
from workers.store.store import Store, map_ahead

RANGES_PER_BLOCK = 128
ROWS_PER_BLOCK = 4_096
"""A block ends with either of them, rows of all tables counted: small enough for memory, large enough to be fast."""

Range = Sequence[CommitRecord]
"""A range's record, followed by its retries."""


@dataclass(frozen=True)
class Block:
    """Consecutive ranges, the files that they name, and the rows of every table in their order."""

    ranges: Sequence[Range]
    files: Sequence[tuple[CommitRecord, FileEntry]]
    """Tars, shapes and tables, each with the record that names it; images are in the rows of `views`."""
    rows: Mapping[str, pa.Table]


@dataclass(frozen=True)
class _RangeRead:
    """A range as it was read: the files of each record, and the tables that have rows, in the schema of their files."""

    records: Range
    files: Sequence[Sequence[FileEntry]]
    tables: Mapping[str, pa.Table]

    @property
    def rows(self) -> int:
        """Of all tables; those of retries are counted with what they replace."""
        return sum(sum(record.tables.values()) for record in self.records)


def read_blocks(store: Store, first_scene: int, stop_scene: int) -> Iterator[Block]:
    """All ranges of [first_scene, stop_scene) in order. Raises as `iter_ranges` and `blocks_of`."""
    return blocks_of(store, iter_ranges(store, first_scene, stop_scene))


def blocks_of(store: Store, ranges: Iterable[Range]) -> Iterator[Block]:
    """Ranges, which are in order, with their rows; of an object store some are read ahead.

    Raises CorruptError naming a table that is missing or altered, or a range that does not hold each of its scenes once.
    """
    block: list[_RangeRead] = []
    rows = 0
    for read in map_ahead(store, lambda records: _read_range(store, records), ranges):
        block.append(read)
        rows += read.rows
        if len(block) >= RANGES_PER_BLOCK or rows >= ROWS_PER_BLOCK:
            yield _joined(block)
            block, rows = [], 0
    if block:
        yield _joined(block)


def _read_range(store: Store, records: Range) -> _RangeRead:
    if len(records) > 1:
        files = [committed_files(store, record) for record in records]
        return _RangeRead(records, files, {table: range_rows(store, records, table) for table in TABLES})
    (record,) = records
    tables = {table: _read_table(store, record, table) for table in TABLES if record.tables[table]}
    return _RangeRead(records, [record.files], tables)


def _read_table(store: Store, record: CommitRecord, table: str) -> pa.Table:
    """The rows of one record. Raises CorruptError where the file is missing or altered, or has more rows or fewer."""
    path = range_table_path(record.span.start, table, record.span.retry)
    rows = decode_rows(read_range_file(store, record, path), path)
    if len(rows) != record.tables[table]:
        raise CorruptError(f"{path} has {len(rows)} rows, and its commit says {record.tables[table]}")
    return rows


def _joined(block: Sequence[_RangeRead]) -> Block:
    """The block's rows, table by table. Raises CorruptError where a range does not hold each scene once."""
    ranges = [read.records for read in block]
    files = [
        (record, entry)
        for read in block
        for record, entries in zip(read.records, read.files, strict=True)
        for entry in entries
        if pose_of_image(entry.path) is None
    ]
    tables = {}
    for table in TABLES:
        parts = [(read.records, read.tables[table]) for read in block if table in read.tables]
        if table == "assets":
            files += [(records[0], entry) for records, rows in parts for entry in _shapes(rows)]
        name = f"a table `{table}` of the ranges from scene {ranges[0][0].span.start}"
        tables[table] = _concatenated(table, [rows for _, rows in parts], name)
        _check_spans(tables[table], parts)
    _check_scenes([records[0].span for records in ranges], tables)
    return Block(ranges, files, tables)


def _check_scenes(spans: Sequence[Span], rows: Mapping[str, pa.Table]) -> None:
    """Raises CorruptError where a scene of the spans was neither made nor failed, or both."""
    ids = np.concatenate([rows[table].column("scene_id").to_numpy() for table in ("scenes", "failures")])
    values, counts = np.unique(ids, return_counts=True)
    wrong = [*np.setxor1d(values, np.arange(spans[0].start, spans[-1].stop)), *values[counts > 1]]
    if wrong:
        raise _not_each_once(next(span.start for span in reversed(spans) if span.start <= wrong[0]))


def _shapes(assets: pa.Table) -> Iterator[FileEntry]:
    """The shapes that a range made, where its own table of assets lists them. Raises CorruptError as `committed_files`."""
    if not {field.name for field in SHAPE_FILE_COLUMNS} <= set(assets.column_names):
        return
    for entry in files_of_assets(assets):
        if not is_range_file(entry.path, 0, 0):
            raise CorruptError(f"a row of assets lists {entry.path!r}, which is not the name of a shape")
        yield entry


def _concatenated(table: str, parts: Sequence[pa.Table], name: str) -> pa.Table:
    """Rows in today's schema, in one piece. Ranges are nearly always of one schema, so it is adapted once."""
    if not parts:
        return SCHEMAS[table].empty_table()
    if any(part.schema != parts[0].schema for part in parts):
        return join_rows(table, [conform(table, part, name) for part in parts]).combine_chunks()
    return conform(table, pa.concat_tables(parts), name).combine_chunks()


def _check_spans(rows: pa.Table, parts: Sequence[tuple[Range, pa.Table]]) -> None:
    """Raises CorruptError where a row is of a scene outside its range."""
    if "scene_id" not in rows.column_names or not parts:
        return
    counts = [len(rows) for _, rows in parts]
    spans = np.repeat([(records[0].span.start, records[0].span.stop) for records, _ in parts], counts, axis=0)
    ids = rows.column("scene_id").to_numpy()
    outside = np.flatnonzero((ids < spans[:, 0]) | (ids >= spans[:, 1]))
    if len(outside):
        raise _not_each_once(int(spans[outside[0], 0]))


def _not_each_once(start: int) -> CorruptError:
    return CorruptError(f"the rows of the range from scene {start} do not hold each scene once")


class PublishedFiles:
    """Checks the files of ranges. What an object store holds is listed once and kept in an SQLite file in `folder`."""

    def __init__(self, store: Store, folder: Path) -> None:
        self._store = store
        self._listed: sqlite3.Connection | None = None
        if store.at_once > 1:  # one listing in place of a request for each file
            with explain_full_disk():
                self._listed = open_scratch(
                    folder / "listed.sqlite", "CREATE TABLE files (path TEXT PRIMARY KEY, bytes INTEGER)"
                )
                self._listed.executemany(
                    "INSERT OR REPLACE INTO files VALUES (?, ?)", ((one.key, one.bytes) for one in store.files(""))
                )

    def check(self, block: Block) -> None:
        """Raises CorruptError naming a file that is missing or has another size than its commit says.

        Tables that have rows were read already, with their checksums. A shape that a mix of stacks shares keeps the size
        of whichever was first.
        """
        named = ((entry.path, entry.bytes, _is_exact(record, entry.path)) for record, entry in unread(block))
        images = ((path, size, True) for path, size in stored_images(block))
        for path, size, exact in chain(named, images):
            found = self._size(path)
            if found is None:
                raise CorruptError(f"{path} is named by a commit and is neither staged nor published")
            if found != size and exact:
                raise CorruptError(f"{path} has {found} bytes, and its commit says {size}")

    def close(self) -> None:
        """Closes the file."""
        if self._listed is not None:
            self._listed.close()

    def _size(self, path: str) -> int | None:
        if self._listed is None:
            return self._store.size(path)
        row = self._listed.execute("SELECT bytes FROM files WHERE path = ?", (path,)).fetchone()
        return row[0] if row else None


def unread(block: Block) -> Iterator[tuple[CommitRecord, FileEntry]]:
    """Tars, shapes and tables without rows."""
    for record, entry in block.files:
        folder, _, name = entry.path.rpartition("/")
        table = name.removesuffix(".parquet")
        if not folder.startswith(RANGES) or not record.tables[table]:
            yield record, entry


def stored_images(block: Block) -> Iterator[tuple[str, int]]:
    """(path, bytes) of the images that are files of their own.

    Raises CorruptError where a view lists what is no image, or one of another scene.
    """
    terms = block.ranges[0][0].terms
    if terms.layout != "files":
        return
    listed = block.rows["views"].column("files").combine_chunks()
    scenes = block.rows["views"].column("scene_id").combine_chunks().take(pc.list_parent_indices(listed)).to_pylist()
    files = listed.flatten()
    for path, size, scene in zip(
        files.field("path").to_pylist(), files.field("bytes").to_pylist(), scenes, strict=True
    ):
        pose = pose_of_image(path)
        if pose is None or pose // (2 * terms.pairs_per_scene) != scene:
            raise CorruptError(f"the views of scene {scene} list {path!r}, which is not an image of that scene")
        yield path, size


def _is_exact(record: CommitRecord, path: str) -> bool:
    return record.terms.fingerprint_mode == "strict" or not is_shape(path)
