"""Stored rows and images of a dataset, range by range or scene by scene, finished or not."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.dataset.tables import DETERMINISTIC_TABLES
from schemas.errors import CorruptError, InputError
from services.run.range_planner import ranges_with_retries
from workers.store.commit import read_record
from workers.store.committed_rows import list_commits, range_rows
from workers.store.images import decode_png
from workers.store.store import Store
from workers.store.tars import read_tar

ReadFile = Callable[[str], bytes]
"""Returns a file's bytes by its path below the output folder."""


@dataclass(frozen=True)
class StoredRange:
    """A committed range: its records, and its rows by table in order, with those of retries in place of the first try's."""

    start: int
    stop: int
    records: tuple[CommitRecord, ...]
    rows: dict[str, list[Row]]

    def scene(self, scene_id: int) -> Row | None:
        """The row of `scenes`, None for a scene that failed."""
        return next((row for row in self.rows["scenes"] if row["scene_id"] == scene_id), None)

    def pairs(self, scene_id: int) -> Iterator[tuple[dict[str, Row], list[Row]]]:
        """(rows of `views` by role, rows of `objects`) of each pair of a scene, by pose id."""
        views = [row for row in self.rows["views"] if row["scene_id"] == scene_id]
        objects = [row for row in self.rows["objects"] if row["scene_id"] == scene_id]
        for parent in sorted({row["parent_id"] for row in views}):
            pair = {row["role"]: row for row in views if row["parent_id"] == parent}
            ids = {row["pose_id"] for row in pair.values()}
            yield pair, [row for row in objects if row["pose_id"] in ids]


def iter_stored(store: Store) -> Iterator[StoredRange]:
    """Every committed range in order. Raises CorruptError where a table does not match its commit."""
    for group in ranges_with_retries(list_commits(store)):
        yield _read_range(store, group[0].start, len(group))


def _read_range(store: Store, start: int, commits: int) -> StoredRange:
    """One committed range and its retries."""
    records = []
    for retry in range(commits):
        record = read_record(store, start, retry)
        if record is None:
            raise CorruptError(f"the commit of the range from scene {start} vanished")
        records.append(record)
    rows = {table: range_rows(store, records, table).to_pylist() for table in DETERMINISTIC_TABLES}
    return StoredRange(start, records[0].span.stop, tuple(records), rows)


def choose_scenes(store: Store, count: int, seed: int) -> list[int]:
    """`count` of the scenes that were made, or all of them, evenly over their ids; the seed sets the first."""
    return choose_evenly([row["scene_id"] for one in iter_stored(store) for row in one.rows["scenes"]], count, seed)


def choose_evenly(scenes: Sequence[int], count: int, seed: int) -> list[int]:
    """`count` of the scenes, or all of them, evenly over their ids; the seed sets the first."""
    ordered = sorted(scenes)
    if count >= len(ordered):
        return ordered
    first = float(np.random.default_rng(seed).random())
    return [ordered[int((i + first) * len(ordered) / count)] for i in range(count)]


def find_scene(store: Store, scene_id: int) -> StoredRange:
    """The range that holds a scene. Raises InputError where it is not committed."""
    for group in ranges_with_retries(list_commits(store)):
        if group[0].start <= scene_id < group[0].stop:
            return _read_range(store, group[0].start, len(group))
    raise InputError(f"scene {scene_id} is not in {store.name}: `verso status {store.name}` tells which scenes are")


def file_reader(read: ReadFile, stored: StoredRange) -> ReadFile:
    """Reads files of a range by path, from their own place or from a tar (each tar is read once).

    `read` is the store's. What comes back raises CorruptError where a file is missing.
    """

    def read_committed(path: str) -> bytes:
        try:
            return read(path)
        except FileNotFoundError as error:
            raise CorruptError(f"{path} is committed and missing: restore it from a copy") from error

    if stored.records[0].terms.layout == "files":
        return read_committed
    members: dict[str, bytes] = {}
    for path in (entry.path for record in stored.records for entry in record.files if entry.path.endswith(".tar")):
        members.update(read_tar(path.partition("/")[0], read_committed(path), path))

    def read_packed(path: str) -> bytes:
        if path not in members:
            raise CorruptError(f"{path} is committed and in no tar")
        return members[path]

    return read_packed


def read_image(read: ReadFile, path: str) -> NDArray:
    """An image by its path. Raises CorruptError where it is missing or no PNG."""
    try:
        return decode_png(read(path), path)
    except ValueError as error:
        raise CorruptError(f"{path} is not a whole PNG: {error}") from error
