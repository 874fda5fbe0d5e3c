"""What ranges share: rows of assets once each, and the sorted list of all files with their digests."""

import json
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import pyarrow as pa

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import ASSETS
from schemas.dataset.tables import SCHEMAS
from schemas.errors import CommitConflict, CorruptError
from services.merge.external_sort import ExternalSort

_ROWS_PER_BATCH = 4_096


class AssetRows:
    """The rows of `assets` of all ranges, each instance once, by instance id."""

    def __init__(self, folder: Path) -> None:
        self._sorted = ExternalSort(folder, "assets")

    def add(self, rows: pa.Table) -> None:
        """Takes the rows of a range, in any order."""
        for row in rows.to_pylist():
            self._sorted.add(row["instance_id"].encode(), json.dumps(row).encode())

    def batches(self, mixed: bool) -> Iterator[pa.Table]:
        """All rows in order.

        Raises CommitConflict where two differ, unless stacks are `mixed`: then one of them is taken, always the same.
        """
        waiting: list[dict[str, object]] = []
        for instance_id, group in groupby(self._sorted, key=lambda pair: pair[0]):
            different = sorted({value for _, value in group})
            if len(different) > 1 and not mixed:
                raise CommitConflict(
                    f"the asset {instance_id.decode()} is described differently by two ranges of one stack"
                )
            waiting.append(json.loads(different[0]))
            if len(waiting) == _ROWS_PER_BATCH:
                yield pa.Table.from_pylist(waiting, schema=SCHEMAS["assets"])
                waiting = []
        yield pa.Table.from_pylist(waiting, schema=SCHEMAS["assets"])


class FileList:
    """(path, SHA-256) of every image, shape and merged file, sorted by the UTF-8 bytes of the path."""

    def __init__(self, folder: Path) -> None:
        self._sorted = ExternalSort(folder, "files")
        self.images = 0

    def add_images(self, views: pa.Table) -> None:
        """Takes the files that rows of `views` name."""
        if not views.num_rows:
            return
        files = pa.concat_arrays(views.column("files").chunks).flatten()
        for path, sha256 in zip(files.field("path").to_pylist(), files.field("sha256").to_pylist(), strict=True):
            self._sorted.add(path.encode(), sha256.encode())
        self.images += len(files)

    def add_shapes(self, record: CommitRecord) -> None:
        """Takes the shapes that a range wrote, or wrote again."""
        for entry in record.files:
            if entry.path.startswith(f"{ASSETS}/"):
                self._sorted.add(entry.path.encode(), entry.sha256.encode())

    def add(self, path: str, sha256: str) -> None:
        """Takes one file."""
        self._sorted.add(path.encode(), sha256.encode())

    def pairs(self, mixed: bool) -> Iterator[tuple[str, str]]:
        """All files in order, shared shapes once.

        Raises CorruptError where an image is named twice, CommitConflict where one shape has two digests, unless stacks
        are `mixed`: then the smaller one counts.
        """
        for name, group in groupby(self._sorted, key=lambda pair: pair[0]):
            path = name.decode()
            digests = [value for _, value in group]
            if len(digests) > 1 and not path.startswith(f"{ASSETS}/"):
                raise CorruptError(f"{path} belongs to two views: the ranges do not join")
            if digests[0] != digests[-1] and not mixed:
                raise CommitConflict(
                    f"{path} was made with two digests by one stack: {digests[0].decode()}, {digests[-1].decode()}"
                )
            yield path, digests[0].decode()
