"""Reading a dataset scene by scene: rows and images as they are stored, finished or not."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from schemas.dataset.commit import CommitRecord
from schemas.dataset.tables import DETERMINISTIC_TABLES
from schemas.errors import CorruptError, InputError
from services.run.range_planner import ranges_with_retries
from workers.store.commit import read_record
from workers.store.committed_rows import list_commits, range_rows
from workers.store.images import decode_png
from workers.store.store import Store
from workers.store.tars import read_tar

Row = dict[str, Any]


@dataclass(frozen=True)
class StoredRange:
    """One committed range with its retries laid over: rows by table, in order, and the records they came from."""

    start: int
    stop: int
    records: tuple[CommitRecord, ...]
    rows: dict[str, list[Row]]


def iter_stored(store: Store) -> Iterator[StoredRange]:
    """Every committed range in order. Raises CorruptError where a table does not match its commit."""
    for group in ranges_with_retries(list_commits(store)):
        yield read_stored(store, group[0].start, len(group))


def read_stored(store: Store, start: int, commits: int) -> StoredRange:
    """One committed range and its retries."""
    records = []
    for retry in range(commits):
        record = read_record(store, start, retry)
        if record is None:
            raise CorruptError(f"the commit of the range from scene {start} vanished")
        records.append(record)
    rows = {table: range_rows(store, records, table).to_pylist() for table in DETERMINISTIC_TABLES}
    return StoredRange(start, records[0].span.stop, tuple(records), rows)


def find_scene(store: Store, scene_id: int) -> StoredRange:
    """The range that holds a scene. Raises InputError where it is not committed."""
    for group in ranges_with_retries(list_commits(store)):
        if group[0].start <= scene_id < group[0].stop:
            return read_stored(store, group[0].start, len(group))
    raise InputError(f"scene {scene_id} is not in {store.name}: `verso status {store.name}` tells which scenes are")


def file_reader(store: Store, stored: StoredRange) -> Callable[[str], bytes]:
    """Reads files of a range by path, whether they lie by themselves or in tars (each tar is read once).

    What it returns raises CorruptError where a file is missing.
    """
    if stored.records[0].terms.layout == "files":
        return lambda path: _read(store, path)
    members: dict[str, bytes] = {}
    for record in stored.records:
        for entry in record.files:
            if entry.path.endswith(".tar"):
                category = entry.path.partition("/")[0]
                members.update(read_tar(category, _read(store, entry.path), entry.path))

    def read_packed(path: str) -> bytes:
        if path not in members:
            raise CorruptError(f"{path} is committed and in no tar")
        return members[path]

    return read_packed


def _read(store: Store, path: str) -> bytes:
    try:
        return store.read(path)
    except FileNotFoundError as error:
        raise CorruptError(f"{path} is committed and missing: restore it from a copy") from error


def read_image(read: Callable[[str], bytes], path: str) -> NDArray:
    """An image by its path. Raises CorruptError where it is missing or no PNG."""
    try:
        return decode_png(read(path), path)
    except ValueError as error:
        raise CorruptError(f"{path} is not a whole PNG: {error}") from error
