"""What ranges share, collected in an SQLite file: rows of assets, and all files with their digests, in sorted order.

SQLite keeps the rows sorted by the UTF-8 bytes of their key, on disk, with a cache of a fixed size.
"""

import json
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.layout import is_shape
from schemas.dataset.tables import SCHEMAS
from schemas.errors import CommitConflict, CorruptError
from services.merge.scratch import explain_full_disk, open_scratch

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
