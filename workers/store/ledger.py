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
from schemas.dataset.layout import COMMITS, LEDGER_FILE, MAX_RETRIES, range_table_path
from schemas.dataset.tables import SORT_KEYS
from schemas.errors import CorruptError, MachineError, RunError
from workers.store.commit import ReadTable, list_codes, read_range_file, require_record, split_code
from workers.store.manifest import PARQUET_OPTIONS, decode_table, join_rows
from workers.store.store import Store, map_ahead


def iter_committed(store: Store) -> Iterator[list[CommitRecord]]:
    """The records of every committed range, followed by its retries, in order.

    Raises CorruptError for a damaged or missing record, OutputError for one of a newer version. Some are read ahead
    where requests wait.
    """
    return map_ahead(store, lambda group: read_range(store, *group), _group(list_codes(store)))


def _group(codes: NDArray[np.int64]) -> Iterator[tuple[int, list[int]]]:
    """(start, retries) of every range. Raises as `read_range`."""
    for start, group in groupby(map(split_code, codes), key=itemgetter(0)):
        retries = [retry for _, retry in group]
        _check_retries(start, retries)
        yield start, retries


def _check_retries(start: int, retries: Sequence[int]) -> None:
    if list(retries) != list(range(len(retries))):
        raise CorruptError(
            f"{COMMITS} has retries {list(retries)} of the range from scene {start}, and must have all from 0: restore it"
        )


def read_range(store: Store, start: int, retries: Sequence[int]) -> list[CommitRecord]:
    """The records of one range. Raises as `iter_committed`, CorruptError where a retry before another one is missing."""
    _check_retries(start, retries)
    return [require_record(store, start, retry) for retry in retries]


def iter_ranges(store: Store, first_scene: int, stop_scene: int) -> Iterator[list[CommitRecord]]:
    """The records of each range, followed by its retries, in order: exactly the scenes [first_scene, stop_scene).

    Raises RunError naming scenes that nobody committed, or that are committed beyond the end.
    """
    awaited = first_scene
    for records in iter_committed(store):
        start, stop = records[0].span.start, records[0].span.stop
        if start > awaited:
            raise _gap(awaited, min(start, stop_scene))
        if start < awaited or stop > stop_scene:
            scene = start if start < awaited else stop - 1
            asked = f"the {first_scene} to {stop_scene - 1} that were asked for"
            raise RunError(f"scene {scene} is committed, outside {asked}")
        awaited = stop
        yield records
    if awaited < stop_scene:
        raise _gap(awaited, stop_scene)


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


def _gap(start: int, stop: int) -> RunError:
    return RunError(f"scenes {start} to {stop - 1} are not committed: run the job again to make them")


_BATCH = 4_096
"""Records that are read before their rows are packed into columns."""
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
    for _ in _group(codes):
        pass  # a missing one is told
    kept = _read_kept(store, codes)
    known = _codes_of(kept)
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
        self._rows = ledger.rows
        self._unkept = len(ledger.unkept) + len(ledger.lost)
        """How many commits the written summary lacks, or has too many."""
        self._waiting: list[CommitSummary] = []
        self.add(())

    def add(self, summaries: Iterable[CommitSummary]) -> None:
        """Takes new commits."""
        self._waiting += summaries
        if self._unkept + len(self._waiting) >= max(SAVE_EACH, SAVE_SHARE * self._rows.num_rows):
            self.close()

    def close(self) -> None:
        """Writes what is not written."""
        if self._unkept or self._waiting:
            self._rows = join_summaries([self._rows, rows_of(self._waiting)])
            self._unkept, self._waiting = 0, []
            with contextlib.suppress(MachineError):  # a full disk stops the run where data are written, not here
                save_rows(self._store, self._rows)


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
        rows = pq.read_table(pa.BufferReader(data), read_dictionary=names)
        return join_summaries([rows.select(LEDGER_SCHEMA.names).cast(LEDGER_SCHEMA)])
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise CorruptError(f"{LEDGER_FILE} is damaged ({error}): remove it, the next run writes it again") from error


def _codes_of(rows: pa.Table) -> NDArray[np.int64]:
    return np.asarray(rows.column("start")) * MAX_RETRIES + np.asarray(rows.column("retry"))


def _read_kept(store: Store, codes: NDArray[np.int64]) -> pa.Table:
    """The rows of the kept summary; none where it is missing, damaged, or of other commits than those that are there."""
    none = LEDGER_SCHEMA.empty_table()
    rows = None
    with contextlib.suppress(CorruptError):
        rows = read_kept_rows(store)
    if rows is None:
        return none
    known = _codes_of(rows)
    shared = np.intersect1d(known, codes, assume_unique=True)
    for code in shared[np.linspace(0, len(shared) - 1, min(_SAMPLES, len(shared))).astype(int)]:
        row = rows.slice(int(np.searchsorted(known, code)), 1)
        if row.to_pylist() != rows_of([read_summary(store, *split_code(code))]).to_pylist():
            return none
    return rows
