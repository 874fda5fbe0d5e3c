"""Columns of the manifest tables in batches, finished or being made: rows of a large dataset are never all in memory."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import itemgetter

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import MANIFEST
from schemas.dataset.tables import CAPTURE_SCHEMAS
from services.merge.merge import read_success
from services.read.stored_tables import category_of, read_merged
from workers.store.commit import list_codes, split_code
from workers.store.ledger import range_rows, read_range
from workers.store.store import Store

MOST_RANGES = 256
"""Largest number of ranges that are read of a dataset that is not merged; more are sampled evenly."""

BATCH_ROWS = 65_536

_INNER = {"files": "files.list.element.bytes"}
"""Columns of which a part is enough; names and digests of files are most of the bytes of `views`."""


@dataclass(frozen=True)
class Tables:
    """The rows of a dataset: its merged files, or those of committed ranges."""

    store: Store
    merged: tuple[str, ...]
    """Merged files; none while the dataset is being made."""
    ranges: tuple[tuple[int, tuple[int, ...]], ...]
    """(first scene, retries) of the ranges that are read where it is not merged."""
    all_ranges: int

    @property
    def sampled(self) -> bool:
        """Whether rows of some ranges only are read."""
        return not self.merged and len(self.ranges) < self.all_ranges

    def batches(self, table: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        """The rows in order of files, with these columns; those that old files lack are null.

        Raises CorruptError where a range's file does not match its commit, pyarrow's errors where a merged one is damaged.
        """
        if self.merged:
            prefix = f"{MANIFEST}/{table}/"
            parts = (
                part for key in self.merged if key.startswith(prefix) for part in self._merged(table, key, columns)
            )
        else:
            parts = (range_rows(self.store, records, table) for records in self._records)
        for part in parts:
            if part.num_rows:
                yield _with_columns(part, table, columns)

    @cached_property
    def _records(self) -> list[list[CommitRecord]]:
        return [read_range(self.store, start, retries) for start, retries in self.ranges]

    def _merged(self, table: str, key: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        if self.store.root is None:
            yield read_merged(table, key, self.store.read(key))
            return
        with pq.ParquetFile(self.store.root / key, page_checksum_verification=True) as file:
            stored = set(file.schema_arrow.names)
            wanted = [_INNER.get(name, name) for name in columns if name in stored]
            for batch in file.iter_batches(BATCH_ROWS, columns=wanted):
                rows = pa.table(batch)
                if "category" in columns and "category" not in stored:
                    rows = rows.append_column("category", pa.repeat(pa.scalar(category_of(key)), rows.num_rows))
                yield rows


def open_tables(store: Store) -> Tables:
    """The tables of a dataset as it is now, which may have no rows yet."""
    done = read_success(store)
    if done is not None:
        return Tables(store, tuple(sorted(done["files"])), (), 0)
    codes = map(split_code, list_codes(store))
    ranges = [(start, tuple(retry for _, retry in group)) for start, group in groupby(codes, key=itemgetter(0))]
    return Tables(store, (), tuple(choose_spread(ranges, MOST_RANGES)), len(ranges))


def choose_spread(items: Sequence, count: int) -> list:
    """`count` of the items, or all of them, evenly from the first to the last."""
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / max(count - 1, 1))] for i in range(count)]


def _with_columns(rows: pa.Table, table: str, columns: Sequence[str]) -> pa.Table:
    schema = CAPTURE_SCHEMAS[table]
    for name in columns:
        if name not in rows.column_names:
            rows = rows.append_column(name, pa.nulls(rows.num_rows, schema.field(name).type))
    return rows.select(list(columns))
