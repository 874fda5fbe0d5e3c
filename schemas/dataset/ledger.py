"""The ledger: what planning and status need of every commit, in columns, about 40 bytes for each."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from schemas.dataset.commit import CommitSummary

_failure = pa.struct(
    [
        pa.field("scene_id", pa.int64(), nullable=False),
        pa.field("kind", pa.string(), nullable=False),
        pa.field("reason", pa.string(), nullable=False),
    ]
)
_name = pa.dictionary(pa.int32(), pa.string())

LEDGER_SCHEMA = pa.schema(
    [
        pa.field("start", pa.int64(), nullable=False),
        pa.field("stop", pa.int64(), nullable=False),
        pa.field("retry", pa.int32(), nullable=False),
        pa.field("made", pa.int32(), nullable=False),
        pa.field("failed", pa.list_(_failure), nullable=False),
        pa.field("scenes", pa.list_(pa.int64()), nullable=False),
        pa.field("fingerprint", _name, nullable=False),
        pa.field("job_digest", _name, nullable=False),
    ]
)
"""Fields of `CommitSummary`."""


def rows_of(summaries: Iterable[CommitSummary]) -> pa.Table:
    """A row of `LEDGER_SCHEMA` for each."""
    keys = ("scene_id", "kind", "reason")
    rows = [
        {**vars(one), "failed": [dict(zip(keys, failure, strict=True)) for failure in one.failed]} for one in summaries
    ]
    return pa.Table.from_pylist(rows, LEDGER_SCHEMA)


def join_rows(parts: Iterable[pa.Table]) -> pa.Table:
    """All rows, by start and retry, each commit once."""
    rows = pa.concat_tables([LEDGER_SCHEMA.empty_table(), *parts]).unify_dictionaries().combine_chunks()
    rows = rows.sort_by([("start", "ascending"), ("retry", "ascending")])
    start, retry = rows.column("start").to_numpy(), rows.column("retry").to_numpy()
    repeated = (start[1:] == start[:-1]) & (retry[1:] == retry[:-1])
    return rows.filter(pa.array(np.append(True, ~repeated))) if repeated.any() else rows


@dataclass(frozen=True)
class Ledger:
    """Every commit of a dataset, by start and retry."""

    rows: pa.Table
    """Of `LEDGER_SCHEMA`."""
    lost: tuple[tuple[int, int], ...] = ()
    """(start, retry) of commits that were there once and are not any more."""
    unkept: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """[U] rows that were read from records, because the kept summary lacks them."""

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """[N] first scene of each commit's range."""
        return self.rows.column("start").to_numpy()

    @cached_property
    def stop(self) -> NDArray[np.int64]:
        """[N] end of each commit's range."""
        return self.rows.column("stop").to_numpy()

    @cached_property
    def retry(self) -> NDArray[np.int32]:
        """[N] 0 for the range itself, k for its k-th retry."""
        return self.rows.column("retry").to_numpy()

    def count(self, row: int) -> int:
        """Number of scenes of one commit."""
        again = len(self.rows.column("scenes")[row])
        return again or int(self.stop[row] - self.start[row])

    @property
    def ranges(self) -> NDArray[np.int64]:
        """[R, 2] start and stop of every committed range, in order."""
        whole = self.retry == 0
        return np.stack([self.start[whole], self.stop[whole]], axis=1)

    @property
    def committed(self) -> int:
        """Number of scenes in committed ranges."""
        whole = self.retry == 0
        return int((self.stop[whole] - self.start[whole]).sum())

    @cached_property
    def failures(self) -> pa.Table:
        """Failures that no retry made good: columns start, scene_id, kind and reason, in order of the scenes."""
        failed, row = self._flat("failed")
        table = pa.table({name: pc.struct_field(failed, name) for name in ("scene_id", "kind", "reason")})
        scene = table.column("scene_id").to_numpy()
        again, of = self._flat("scenes")
        last = dict(zip(again.to_pylist(), self.retry[of].tolist(), strict=True))  # later retries come later
        stands = np.array([last.get(one, 0) for one in scene.tolist()], np.int32) == self.retry[row]
        table = table.append_column("start", pa.array(self.start[row])).filter(pa.array(stands))
        return table.sort_by([("scene_id", "ascending")])

    @property
    def fingerprints(self) -> list[str]:
        """The stacks that made the commits, sorted."""
        return sorted(pc.unique(self.rows.column("fingerprint")).to_pylist())

    def _flat(self, name: str) -> tuple[pa.Array, NDArray[np.int64]]:
        """The items of a list column, and the row of each."""
        lists = self.rows.column(name).combine_chunks()
        lists = lists.combine_chunks() if isinstance(lists, pa.ChunkedArray) else lists
        lengths = pc.fill_null(pc.list_value_length(lists), 0).to_numpy(zero_copy_only=False)
        return lists.flatten(), np.repeat(np.arange(len(lengths)), lengths)
