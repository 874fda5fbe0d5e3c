"""Whether every file that commits name is in its final place with its size: asked of a disk, looked up in a store's listing."""

import sqlite3
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import is_shape, range_table_path
from schemas.errors import CorruptError
from services.merge.reading import Block
from services.merge.scratch import explain_full_disk, open_scratch
from workers.store.store import Store


class PublishedFiles:
    """Checks the files of ranges. What an object store holds is listed once and kept in an SQLite file in `folder`."""

    def __init__(self, store: Store, folder: Path) -> None:
        self._store = store
        self._listed: sqlite3.Connection | None = None
        if store.root is None:
            self._listed = open_scratch(
                folder / "listed.sqlite", "CREATE TABLE files (path TEXT PRIMARY KEY, bytes INTEGER)"
            )
            with explain_full_disk():
                self._listed.executemany("INSERT OR REPLACE INTO files VALUES (?, ?) ", store.listing())

    def check(self, block: Block) -> None:
        """Raises CorruptError naming a file that is missing or has another size than its commit says.

        Tables that have rows were read already, with their checksums. A shape that a mix of stacks shares keeps the size
        of whichever was first.
        """
        records = list(chain.from_iterable(block.ranges))
        for path, size, exact in chain(*map(_named, records), _images(records, block.rows["views"])):
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


def _named(record: CommitRecord) -> Iterator[tuple[str, int, bool]]:
    """(path, bytes, whether they must agree) of tars, shapes and tables without rows."""
    strict = record.terms.fingerprint_mode == "strict"
    read = {
        range_table_path(record.span.start, table, record.span.retry)
        for table, entry in record.tables.items()
        if entry.rows
    }
    for entry in record.files:
        if entry.path not in read and not entry.path.endswith(".png"):
            yield entry.path, entry.bytes, strict or not is_shape(entry.path)


def _images(records: Iterable[CommitRecord], views: pa.Table) -> Iterator[tuple[str, int, bool]]:
    """The same of images that are files of their own."""
    if any(record.terms.layout == "files" for record in records):
        files = pc.list_flatten(views.column("files"))
        for path, size in zip(*(pc.struct_field(files, name).to_pylist() for name in ("path", "bytes")), strict=True):
            yield path, size, True
