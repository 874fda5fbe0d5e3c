"""Reading of committed ranges in order, and of their rows; a retry's rows replace the first ones."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Protocol, TypeVar

import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import range_table_path
from schemas.dataset.tables import SORT_KEYS
from schemas.errors import RunError
from workers.store.commit import check_retries, list_codes, read_range_file, require_record, split_code
from workers.store.ledger import list_commits as list_commits
from workers.store.manifest import decode_table, join_rows
from workers.store.store import Store

A = TypeVar("A")
B = TypeVar("B")


class Spread(Protocol):
    """Calls a function for each item and gives the results in order, as `map` does; it may call ahead, several at once."""

    def __call__(self, function: Callable[[A], B], items: Iterable[A], /) -> Iterator[B]:
        """The results in order."""


def iter_committed(store: Store, spread: Spread = map) -> Iterator[list[CommitRecord]]:
    """The records of every committed range, followed by its retries, in order.

    Raises CorruptError for a damaged or missing record, OutputError for one of a newer version.
    """
    ranges = groupby(map(split_code, list_codes(store)), key=itemgetter(0))
    groups = ((start, [retry for _, retry in names]) for start, names in ranges)
    return spread(lambda group: read_range(store, *group), groups)


def read_range(store: Store, start: int, retries: Sequence[int]) -> list[CommitRecord]:
    """The records of one range. Raises as `iter_committed`."""
    check_retries(start, retries)
    return [require_record(store, start, retry) for retry in retries]


def iter_ranges(store: Store, first_scene: int, stop_scene: int, spread: Spread = map) -> Iterator[list[CommitRecord]]:
    """The records of each range, followed by its retries, in order: exactly the scenes [first_scene, stop_scene).

    Raises RunError naming scenes that nobody committed, or that are committed beyond the end.
    """
    awaited = first_scene
    for records in iter_committed(store, spread):
        start, stop = records[0].span.start, records[0].span.stop
        if start != awaited:
            raise RunError(
                _gap(awaited, min(start, stop_scene)) if start > awaited else _beyond(start, first_scene, stop_scene)
            )
        awaited = stop
        if awaited > stop_scene:
            raise RunError(_beyond(awaited - 1, first_scene, stop_scene))
        yield records
    if awaited < stop_scene:
        raise RunError(_gap(awaited, stop_scene))


def range_rows(store: Store, records: Sequence[CommitRecord], table: str) -> pa.Table:
    """The rows of one range, sorted by key; a retry's rows replace those of the scenes that it tried again.

    Rows of `assets` come from all records and may be repeated. Raises CorruptError naming a file that does not match its
    commit.
    """
    parts = [read_range_table(store, record, table) for record in records]
    if len(parts) == 1:
        return parts[0]
    if "scene_id" in parts[0].column_names:
        for number, part in enumerate(parts):
            later = {scene_id for record in records[number + 1 :] for scene_id in record.span.scenes}
            again = pc.is_in(part.column("scene_id"), value_set=pa.array(sorted(later), pa.int64()))
            parts[number] = part.filter(pc.invert(again))
    return join_rows(table, parts).sort_by([(key, "ascending") for key in SORT_KEYS[table]])


def read_range_table(store: Store, record: CommitRecord, table: str) -> pa.Table:
    """The rows that one record committed. Raises CorruptError naming a file that is missing or altered."""
    path = range_table_path(record.span.start, table, record.span.retry)
    return decode_table(table, read_range_file(store, record, path), path)


def _gap(start: int, stop: int) -> str:
    return f"scenes {start} to {stop - 1} are not committed: run the job again to make them"


def _beyond(scene: int, first_scene: int, stop_scene: int) -> str:
    return f"scene {scene} is committed, outside the {first_scene} to {stop_scene - 1} that were asked for"
