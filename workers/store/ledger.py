"""What planning, status, merge and readers ask of all commits: records in order, their rows, and a kept summary.

Names of commits come from a listing, the summary from one file, and only what that file lacks from the records. A retry's
rows replace the first ones.
"""

import contextlib
import hashlib
import io
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby, islice
from operator import itemgetter

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from schemas.dataset.commit import LEDGER_SCHEMA, CommitRecord, CommitSummary, Ledger, rows_of, summarize
from schemas.dataset.commit import join_rows as join_summaries
from schemas.dataset.layout import LEDGER_FILE, MAX_RETRIES, range_table_path
from schemas.dataset.tables import SORT_KEYS
from schemas.errors import CorruptError, MachineError, RunError
from workers.store.commit import ReadTable, check_retries, list_codes, read_range_file, require_record, split_code
from workers.store.manifest import PARQUET_OPTIONS, decode_table, join_rows
from workers.store.store import Store, map_ahead


def iter_committed(store: Store) -> Iterator[list[CommitRecord]]:
    """The records of every committed range, followed by its retries, in order.

    Raises CorruptError for a damaged or missing record, OutputError for one of a newer version. Some are read ahead
    where requests wait.
    """
    ranges = groupby(map(split_code, list_codes(store)), key=itemgetter(0))
    groups = ((start, [retry for _, retry in names]) for start, names in ranges)
    return map_ahead(store, lambda group: read_range(store, *group), groups)


def read_range(store: Store, start: int, retries: Sequence[int]) -> list[CommitRecord]:
    """The records of one range. Raises as `iter_committed`."""
    check_retries(start, retries)
    return [require_record(store, start, retry) for retry in retries]


def iter_ranges(store: Store, first_scene: int, stop_scene: int) -> Iterator[list[CommitRecord]]:
    """The records of each range, followed by its retries, in order: exactly the scenes [first_scene, stop_scene).

    Raises RunError naming scenes that nobody committed, or that are committed beyond the end.
    """
    awaited = first_scene
    for records in iter_committed(store):
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


def range_rows(
    store: Store, records: Sequence[CommitRecord], table: str, read: ReadTable = read_range_file
) -> pa.Table:
    """The rows of one range, sorted by key; a retry's rows replace those of the scenes that it tried again.

    Rows of `assets` come from all records and may be repeated. Raises CorruptError naming a file that does not match its
    commit.
    """
    paths = [range_table_path(record.span.start, table, record.span.retry) for record in records]
    parts = [decode_table(table, read(store, record, path), path) for record, path in zip(records, paths, strict=True)]
    if len(parts) == 1:
        return parts[0]
    if "scene_id" in parts[0].column_names:
        for number, part in enumerate(parts):
            later = {scene_id for record in records[number + 1 :] for scene_id in record.span.scenes}
            again = pc.is_in(part.column("scene_id"), value_set=pa.array(sorted(later), pa.int64()))
            parts[number] = part.filter(pc.invert(again))
    return join_rows(table, parts).sort_by([(key, "ascending") for key in SORT_KEYS[table]])


def _gap(start: int, stop: int) -> str:
    return f"scenes {start} to {stop - 1} are not committed: run the job again to make them"


def _beyond(scene: int, first_scene: int, stop_scene: int) -> str:
    return f"scene {scene} is committed, outside the {first_scene} to {stop_scene - 1} that were asked for"


_BATCH = 4_096
"""Records that are read before their rows are packed into columns."""
_AT_ONCE = 16
"""Requests to an object store at once."""
_SAMPLES = 4
"""Records that a kept summary is compared with: one of another dataset has another job digest in all of them."""
SAVE_EACH = 1_024
"""Fewest commits that make the holder of the lock write the summary again."""
SAVE_SHARE = 0.02
"""Share of all commits by which they grow before the summary is written again: all writing together is fifty times its size,
and after a kill at most this share of the records is read again."""


def list_commits(store: Store) -> Ledger:
    """Every commit of the dataset.

    Raises CorruptError for a damaged or missing record that is not in the kept summary, OutputError for one of a newer
    version.
    """
    codes = list_codes(store)
    _check_all_retries(codes)
    kept = _read_kept(store, codes)
    known = np.asarray(kept.column("start")) * MAX_RETRIES + np.asarray(kept.column("retry"))
    lost = tuple(split_code(code) for code in np.setdiff1d(known, codes, assume_unique=True))
    if lost:
        kept = kept.filter(pa.array(np.isin(known, codes)))
    unread = np.setdiff1d(codes, known, assume_unique=True)
    parts = [kept]
    summaries = map_ahead(store, lambda code: read_summary(store, *split_code(code)), unread)
    while batch := list(islice(summaries, _BATCH)):
        parts.append(rows_of(batch))
    return Ledger(join_summaries(parts), lost, np.searchsorted(codes, unread))


def read_summary(store: Store, start: int, retry: int = 0) -> CommitSummary:
    """The summary of a record. Raises as `require_record`."""
    return summarize(require_record(store, start, retry))


def save_rows(store: Store, rows: pa.Table) -> None:
    """Writes the kept summary: for the holder of the lock alone."""
    sink = io.BytesIO()
    pq.write_table(rows, sink, **PARQUET_OPTIONS)
    data = sink.getvalue()
    store.put(LEDGER_FILE, hashlib.sha256(data).hexdigest().encode() + b"\n" + data)


class LedgerKeeper:
    """Adds new commits to the kept summary, and writes it when enough have come. For the holder of the lock alone."""

    def __init__(self, store: Store, ledger: Ledger) -> None:
        self._store = store
        self._parts = [ledger.rows]
        self._count = ledger.rows.num_rows
        self._unkept = len(ledger.unkept) + len(ledger.lost)
        self._waiting: list[CommitSummary] = []
        self._save_if_due()

    def add(self, summaries: Iterable[CommitSummary]) -> None:
        """Takes new commits."""
        self._waiting += summaries
        if len(self._waiting) >= _BATCH or self._unkept + len(self._waiting) >= SAVE_EACH:
            self._pack()
            self._save_if_due()

    def close(self) -> None:
        """Writes what is not written."""
        self._pack()
        if self._unkept:
            self._save()

    def _pack(self) -> None:
        self._parts.append(rows_of(self._waiting))
        self._count += len(self._waiting)
        self._unkept += len(self._waiting)
        self._waiting = []

    def _save_if_due(self) -> None:
        if self._unkept >= max(SAVE_EACH, SAVE_SHARE * self._count):
            self._save()

    def _save(self) -> None:
        self._parts = [join_summaries(self._parts)]
        with contextlib.suppress(MachineError):  # a full disk stops the run where data are written, not here
            save_rows(self._store, self._parts[0])
        self._unkept = 0


def _check_all_retries(codes: NDArray[np.int64]) -> None:
    start, retry = np.divmod(codes, MAX_RETRIES)
    awaited = np.where(start[1:] == start[:-1], retry[:-1] + 1, 0)
    if (broken := np.flatnonzero(retry != np.append(np.zeros(len(codes[:1]), np.int64), awaited))).size:
        at = start[broken[0]]
        check_retries(int(at), retry[start == at].tolist())


def read_kept_rows(store: Store) -> pa.Table | None:
    """The rows of the kept summary as they were written, None where there is none. Raises CorruptError where it is damaged."""
    try:
        seal, _, data = store.read(LEDGER_FILE).partition(b"\n")
    except FileNotFoundError:
        return None
    if seal != hashlib.sha256(data).hexdigest().encode():
        raise CorruptError(f"{LEDGER_FILE} is damaged: remove it, the next run writes it again")
    try:
        names = ["fingerprint", "job_digest"]
        with pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True, read_dictionary=names) as file:
            return join_summaries([file.read().select(LEDGER_SCHEMA.names).cast(LEDGER_SCHEMA)])
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise CorruptError(
            f"{LEDGER_FILE} cannot be read ({error}): remove it, the next run writes it again"
        ) from error


def _read_kept(store: Store, codes: NDArray[np.int64]) -> pa.Table:
    """The rows of the kept summary; none where it is missing, damaged, or of other commits than those that are there."""
    none = LEDGER_SCHEMA.empty_table()
    try:
        rows = read_kept_rows(store)
    except CorruptError:
        rows = None
    if rows is None:
        return none
    known = np.asarray(rows.column("start")) * MAX_RETRIES + np.asarray(rows.column("retry"))
    shared = np.intersect1d(known, codes, assume_unique=True)
    for code in shared[np.linspace(0, len(shared) - 1, min(_SAMPLES, len(shared))).astype(int)]:
        row = rows.slice(int(np.searchsorted(known, code)), 1)
        if row.to_pylist() != rows_of([read_summary(store, *split_code(code))]).to_pylist():
            return none
    return rows
