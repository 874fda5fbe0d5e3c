"""The merge of ranges that `verify` has read, made again in a temporary folder: what `_SUCCESS` and its files must be."""

from pathlib import Path
from typing import Any

from schemas.dataset.layout import pose_of_image
from schemas.dataset.tables import TABLES
from services.merge.merge import Merging
from services.merge.reading import RANGES_PER_BLOCK, ROWS_PER_BLOCK, Block
from services.read.verify_range import ReadRange
from workers.store.manifest import join_rows


class Remerge:
    """Takes whole ranges in order, and joins their rows in blocks as the merge does."""

    def __init__(self, folder: Path) -> None:
        self._merging = Merging(folder)
        self._waiting: list[ReadRange] = []
        self._rows = 0

    def add(self, one: ReadRange) -> None:
        """Takes the next range, with its rows. Raises CorruptError where rows do not join."""
        assert one.rows is not None
        self._waiting.append(one)
        self._rows += sum(map(len, one.rows.values()))
        if len(self._waiting) >= RANGES_PER_BLOCK or self._rows >= ROWS_PER_BLOCK:
            self._flush()

    def finish(self) -> tuple[dict[str, Any], dict[str, Path]]:
        """The contents of `_SUCCESS`, and the finished files by key. Raises CorruptError, CommitConflict."""
        self._flush()
        return self._merging.finish()

    def close(self) -> None:
        """Closes every file, finished or not."""
        self._merging.close()

    def _flush(self) -> None:
        waiting, self._waiting, self._rows = self._waiting, [], 0
        if not waiting:
            return
        files = [(one.records[0], entry) for one in waiting for entry in one.files if pose_of_image(entry.path) is None]
        rows = {
            table: join_rows(table, [one.rows[table] for one in waiting if one.rows]).combine_chunks()
            for table in TABLES
        }
        self._merging.add(Block([one.records for one in waiting], files, rows))
