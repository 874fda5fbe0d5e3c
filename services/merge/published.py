"""Whether every file that commits name is in its final place with its size: asked of a disk, looked up in a store's listing."""

import sqlite3
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pyarrow.compute as pc

from schemas.dataset.commit import CommitRecord, FileEntry
from schemas.dataset.layout import RANGES, is_shape, pose_of_image
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
            with explain_full_disk():
                self._listed = open_scratch(
                    folder / "listed.sqlite", "CREATE TABLE files (path TEXT PRIMARY KEY, bytes INTEGER)"
                )
                self._listed.executemany("INSERT OR REPLACE INTO files VALUES (?, ?) ", store.listing())

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
        if not folder.startswith(RANGES) or not record.tables[table].rows:
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
        if pose is None or (terms.pairs_per_scene and pose // (2 * terms.pairs_per_scene) != scene):
            raise CorruptError(f"the views of scene {scene} list {path!r}, which is not an image of that scene")
        yield path, size


def _is_exact(record: CommitRecord, path: str) -> bool:
    return record.terms.fingerprint_mode == "strict" or not is_shape(path)
