"""The folder of a merge, and the SQLite file in it that sorts what ranges share: assets, and the digests of all files.

SQLite keeps rows sorted by the UTF-8 bytes of their key, on disk, with a cache of a fixed size.
"""

import contextlib
import json
import sqlite3
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.layout import is_shape
from schemas.dataset.tables import SCHEMAS
from schemas.errors import CommitConflict, CorruptError, MachineError, RunError
from workers.store.store import Store

SCRATCH = "merge"
"""The name of the folder."""
CACHE_KIB = 16 << 10
"""Memory for SQLite's cache."""


@contextlib.contextmanager
def merge_folder(store: Store) -> Iterator[Path]:
    """An empty folder for the files of a merge; that of an earlier merge goes first, wherever that merge is.

    Raises MachineError where a file in it cannot be written, RunError where it is taken away in turn.
    """
    try:
        with explain_full_disk(), store.scratch(SCRATCH) as folder:
            yield folder
    except FileNotFoundError as error:
        raise RunError(
            f"{error.filename or SCRATCH} was removed while {store.name} was merged: another coordinator merges here; "
            "start again when it has ended"
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


@contextlib.contextmanager
def explain_full_disk() -> Iterator[None]:
    """Turns an error of SQLite or of writing a file into a MachineError. A file that is gone stays FileNotFoundError."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (sqlite3.Error, OSError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else error
        raise MachineError(
            f"the merge could not write its files: {reason}; free some space and start again, nothing finished is lost"
        ) from error


_TABLES = """
CREATE TABLE assets (instance_id TEXT, row TEXT, PRIMARY KEY (instance_id, row)) WITHOUT ROWID;
CREATE TABLE files (path TEXT, sha256 TEXT, times INTEGER, PRIMARY KEY (path, sha256)) WITHOUT ROWID
"""


class SharedRows:
    """Takes assets and files range by range, in any order, and gives them back sorted."""

    def __init__(self, folder: Path) -> None:
        with explain_full_disk():
            self._db = open_scratch(folder / "shared.sqlite", _TABLES)
        self.images = 0

    def add_assets(self, rows: pa.Table) -> None:
        """Takes rows of `assets`."""
        pairs = ((row["instance_id"], json.dumps(row)) for row in rows.to_pylist())
        self._insert("assets VALUES (?, ?) ON CONFLICT DO NOTHING", pairs)

    def add_images(self, views: pa.Table) -> None:
        """Takes the files that rows of `views` name."""
        files = pc.list_flatten(views.column("files"))
        columns = (pc.struct_field(files, name).to_pylist() for name in ("path", "sha256"))
        self.add_files(zip(*columns, strict=True))
        self.images += len(files)

    def add_files(self, files: Iterable[tuple[str, str]]) -> None:
        """Takes (path, SHA-256) of files."""
        self._insert("files VALUES (?, ?, 1) ON CONFLICT DO UPDATE SET times = times + 1", files)

    def assets(self, mixed: bool) -> Iterator[pa.Table]:
        """The rows of `assets`, each instance once, by instance id.

        Raises CommitConflict where two differ, unless stacks are `mixed`: then always the same one is taken.
        """
        selected = self._select("instance_id, min(row), count(*) FROM assets")
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
        for path, low, high, times in self._select("path, min(sha256), max(sha256), sum(times) FROM files"):
            if times > 1 and not is_shape(path):
                raise CorruptError(f"{path} belongs to two views: the ranges do not join")
            if low != high and not mixed:
                raise CommitConflict(f"{path} was made with two digests by one stack: {low}, {high}")
            yield path, low

    def close(self) -> None:
        """Closes the file."""
        self._db.close()

    def _insert(self, what: str, rows: Iterable[tuple[str, str]]) -> None:
        with explain_full_disk():
            self._db.executemany(f"INSERT INTO {what}", rows)

    def _select(self, what: str) -> Iterator[tuple]:
        """Rows by the first column, which is read in the order of the primary key: nothing is sorted in memory."""
        with explain_full_disk():
            yield from self._db.execute(f"SELECT {what} GROUP BY 1 ORDER BY 1")
