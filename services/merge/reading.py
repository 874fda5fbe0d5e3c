"""Committed ranges on their way into the merge: their rows, the check that their files are published, and what they share.

What ranges share, assets and the digests of all files, is sorted by an SQLite file in the folder of the merge. SQLite keeps
rows sorted by the UTF-8 bytes of their key, on disk, with a cache of a fixed size. DuckDB would not do: at ten million files
it gives up with a limit of 64 MiB, and at 400,000 rows of views with 128 MiB.
"""

import contextlib
import json
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.commit import CommitRecord, FileEntry, Span
from schemas.dataset.layout import is_shape, range_table_path
from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import CommitConflict, CorruptError, MachineError, RunError
from workers.store.commit import committed_files, read_range_file
from workers.store.ledger import iter_ranges, range_rows
from workers.store.manifest import decode_rows
from workers.store.store import Store, map_ahead

SCRATCH = "merge"
"""The name of the folder of a merge."""
CACHE_KIB = 16 << 10
"""Memory for SQLite's cache."""


@dataclass(frozen=True)
class RangeRows:
    """A range as it was read."""

    records: Sequence[CommitRecord]
    """Its record, followed by its retries."""
    files: Sequence[FileEntry]
    """Of all records."""
    rows: Mapping[str, pa.Table]
    """By table, sorted by key; of a range that was not retried, in the schema of its files, and without empty tables."""


def read_ranges(store: Store, first_scene: int, stop_scene: int) -> Iterator[RangeRows]:
    """All ranges of [first_scene, stop_scene) in order; of an object store some are read ahead.

    Raises as `iter_ranges`, and CorruptError naming a table that is missing or altered, or a range that does not hold
    each of its scenes once.
    """
    return map_ahead(store, partial(_read_range, store), iter_ranges(store, first_scene, stop_scene))


def _read_range(store: Store, records: Sequence[CommitRecord]) -> RangeRows:
    known: dict[str, bytes] = {}

    def read_once(store: Store, record: CommitRecord, path: str) -> bytes:
        known[path] = known.get(path) or read_range_file(store, record, path)
        return known[path]

    files = [entry for record in records for entry in committed_files(store, record, read_once)]
    rows = {}
    for table in TABLES:
        path = range_table_path(records[0].span.start, table)
        if len(records) > 1:
            rows[table] = range_rows(store, records, table, read_once)
        elif records[0].tables[table]:
            rows[table] = decode_rows(read_once(store, records[0], path), path)
    _check_scenes(records[0].span, rows)
    return RangeRows(records, files, rows)


def _check_scenes(span: Span, rows: Mapping[str, pa.Table]) -> None:
    """Raises CorruptError where a scene of the range was neither made nor failed, or both, or a row is of another scene."""
    ids = {table: rows[table].column("scene_id").to_pylist() for table in rows if table != "assets"}
    scenes = list(range(span.start, span.stop))
    if sorted(ids.get("scenes", []) + ids.get("failures", [])) != scenes or not set(scenes) >= set().union(
        *ids.values()
    ):
        raise CorruptError(f"the rows of the range from scene {span.start} do not hold each scene once")


@contextlib.contextmanager
def stored_sizes(store: Store, folder: Path) -> Iterator[Callable[[str], int | None]]:
    """A function that gives the bytes of the file at a path, None where there is none.

    What an object store holds is listed once, in place of a request for each file, and kept in an SQLite file in `folder`.
    """
    if store.at_once == 1:
        yield store.size
        return
    with contextlib.closing(PathTable(folder / "listed.sqlite")) as listed:
        listed.add_all((entry.key, entry.bytes) for entry in store.files(""))
        yield listed.get


def check_published(read: RangeRows, size_of: Callable[[str], int | None]) -> None:
    """Raises CorruptError naming a file of the range that is missing or has another size than its commit says.

    A shape that a mix of stacks shares keeps the size of whichever was first.
    """
    strict = read.records[0].terms.fingerprint_mode == "strict"
    for entry in read.files:
        size = size_of(entry.path)
        if size is None:
            raise CorruptError(f"{entry.path} is named by a commit and is neither staged nor published")
        if size != entry.bytes and (strict or not is_shape(entry.path)):
            raise CorruptError(f"{entry.path} has {size} bytes, and its commit says {entry.bytes}")


@contextlib.contextmanager
def merge_folder(store: Store) -> Iterator[Path]:
    """An empty folder for the files of a merge; that of an earlier merge goes first, wherever that merge is.

    Raises MachineError where a file in it cannot be written, RunError where it is taken away in turn.
    """
    try:
        with store.scratch(SCRATCH) as folder:
            yield folder
    except FileNotFoundError as error:
        raise RunError(
            f"{error.filename or SCRATCH} was removed while {store.name} was merged: another coordinator merges here; "
            "start again when it has ended"
        ) from error
    except (sqlite3.Error, OSError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else error
        raise MachineError(
            f"the merge could not write its files: {reason}; free some space and start again, nothing finished is lost"
        ) from error


def open_scratch(path: Path, tables: str) -> sqlite3.Connection:
    """A new SQLite file with these tables. No journal and no flush: whoever comes later begins with a new file."""
    # No other process opens the file, and file locks may be missing on a network drive.
    uri = f"{path.absolute().as_uri()}?nolock=1"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None)
    try:
        connection.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
        connection.executescript(f"PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; {tables}; BEGIN;")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


class PathTable:
    """What is known of paths, given in any order; on the disk, in constant memory. Raises sqlite3's errors."""

    def __init__(self, file: Path) -> None:
        self._db = open_scratch(file, "CREATE TABLE paths (path BLOB PRIMARY KEY, known) WITHOUT ROWID")

    def add_all(self, entries: Iterable[tuple[str, object]]) -> None:
        """Takes paths with what is known of them; what is known of one already stays."""
        rows = ((os.fsencode(path), known) for path, known in entries)
        self._db.executemany("INSERT INTO paths VALUES (?, ?) ON CONFLICT DO NOTHING", rows)

    def add_paths(self, paths: Iterable[str]) -> None:
        """Takes paths of which nothing is known."""
        self.add_all((path, "") for path in paths)

    def get(self, path: str) -> Any:
        """What is known of a path, None of one that was not given."""
        row = self._db.execute("SELECT known FROM paths WHERE path = ?", (os.fsencode(path),)).fetchone()
        return row[0] if row else None

    def close(self) -> None:
        """Closes the file."""
        self._db.close()


_TABLES = """
CREATE TABLE assets (instance_id TEXT, row TEXT, PRIMARY KEY (instance_id, row)) WITHOUT ROWID;
CREATE TABLE files (path TEXT, sha256 TEXT, times INTEGER, PRIMARY KEY (path, sha256)) WITHOUT ROWID
"""
_ASSETS = "SELECT instance_id, min(row), count(*) FROM assets GROUP BY 1 ORDER BY 1"
_FILES = "SELECT path, min(sha256), max(sha256), sum(times) FROM files GROUP BY 1 ORDER BY 1"
"""Both read in the order of the primary key: nothing is sorted in memory."""


class SharedRows:
    """Takes assets and files range by range, in any order, and gives them back sorted. Raises sqlite3's errors."""

    def __init__(self, folder: Path) -> None:
        self._db = open_scratch(folder / "shared.sqlite", _TABLES)
        self.images = 0

    def add_assets(self, rows: pa.Table) -> None:
        """Takes rows of `assets`."""
        pairs = ((row["instance_id"], json.dumps(row)) for row in rows.to_pylist())
        self._db.executemany("INSERT INTO assets VALUES (?, ?) ON CONFLICT DO NOTHING", pairs)

    def add_images(self, views: pa.Table) -> None:
        """Takes the files that rows of `views` name."""
        files = pc.list_flatten(views.column("files"))
        columns = (pc.struct_field(files, name).to_pylist() for name in ("path", "sha256"))
        self.add_files(zip(*columns, strict=True))
        self.images += len(files)

    def add_files(self, files: Iterable[tuple[str, str]]) -> None:
        """Takes (path, SHA-256) of files."""
        self._db.executemany("INSERT INTO files VALUES (?, ?, 1) ON CONFLICT DO UPDATE SET times = times + 1", files)

    def assets(self, mixed: bool) -> Iterator[pa.Table]:
        """The rows of `assets`, each instance once, by instance id.

        Raises CommitConflict where two differ, unless stacks are `mixed`: then always the same one is taken.
        """
        selected = self._db.execute(_ASSETS)
        while batch := list(islice(selected, 4_096)):
            for instance_id, _, count in batch:
                if count > 1 and not mixed:
                    raise CommitConflict(f"the asset {instance_id} is described differently by two ranges of one stack")
            yield pa.Table.from_pylist([json.loads(row) for _, row, _ in batch], schema=SCHEMAS["assets"])

    def files(self, mixed: bool) -> Iterator[tuple[str, str]]:
        """(path, SHA-256) of every file, sorted by the UTF-8 bytes of the path, shared shapes once.

        Raises CorruptError where an image is named twice, CommitConflict where one shape has two digests, unless stacks
        are `mixed`: then the smaller one counts.
        """
        for path, low, high, times in self._db.execute(_FILES):
            if times > 1 and not is_shape(path):
                raise CorruptError(f"{path} belongs to two views: the ranges do not join")
            if low != high and not mixed:
                raise CommitConflict(f"{path} was made with two digests by one stack: {low}, {high}")
            yield path, low

    def close(self) -> None:
        """Closes the file."""
        self._db.close()
