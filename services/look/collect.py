"""The figures of a dataset from batches of its tables: rows of a large dataset are never all in memory."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from operator import itemgetter

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.commit import CommitRecord
from services.job.record import read_success
from services.look.charts import Histogram
from services.read.dataset_reader import StoredTables
from workers.store.commit import list_codes, split_code
from workers.store.ledger import range_rows, read_range
from workers.store.manifest import join_rows
from workers.store.store import Store

MOST_RANGES = 256
"""Largest number of ranges that are read of a dataset that is not merged; more are sampled evenly."""

BATCH_ROWS = 16_384


@dataclass(frozen=True)
class Tables:
    """The rows of a dataset: its merged tables, or those of committed ranges."""

    store: Store
    merged: bool
    ranges: tuple[tuple[int, tuple[int, ...]], ...]
    """(first scene, retries) of the ranges that are read where it is not merged."""
    sampled: bool
    """Whether rows of some ranges only are read."""

    def batches(self, table: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        """The rows in order of files, with these columns; those that old files lack are null.

        Raises CorruptError where a range's file does not match its commit, pyarrow's errors where a merged one is damaged.
        """
        if self.merged:
            rows = StoredTables(self.store).dataset(table)
            for batch in rows.to_batches(columns=list(columns), batch_size=BATCH_ROWS):
                yield pa.table(batch)
        for records in self._records:
            yield join_rows(table, [range_rows(self.store, records, table)]).select(list(columns))

    @cached_property
    def _records(self) -> list[list[CommitRecord]]:
        return [read_range(self.store, start, retries) for start, retries in self.ranges]


def open_tables(store: Store) -> Tables:
    """The tables of a dataset as it is now, which may have no rows yet."""
    if read_success(store) is not None:
        return Tables(store, True, (), False)
    codes = map(split_code, list_codes(store))
    ranges = [(start, tuple(retry for _, retry in group)) for start, group in groupby(codes, key=itemgetter(0))]
    return Tables(store, False, tuple(choose_spread(ranges, MOST_RANGES)), len(ranges) > MOST_RANGES)


def choose_spread(items: Sequence, count: int) -> list:
    """`count` of the items, or all of them, evenly from the first to the last."""
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / max(count - 1, 1))] for i in range(count)]


@dataclass
class Cost:
    """How often something ran and what it took."""

    runs: int = 0
    seconds: float = 0.0
    timed: int = 0
    """How many of the runs have a time."""
    skips: Counter[str] = field(default_factory=Counter)
    """How often it was left out, by reason."""


@dataclass(frozen=True)
class Failure:
    """Scenes that failed in one way, with an example."""

    reason: str
    kind: str
    stage: str
    scenes: int
    examples: tuple[int, ...]
    detail: str


GROUNDS = ("table", "board")
"""Categories of assets that objects stand on."""

MOST_EXAMPLES = 5
DISTANCE_M = (0.0, 9.6)


@dataclass
class Figures:
    """What the tables of a dataset say."""

    sampled: bool
    """Whether some of the ranges only were read."""
    by_category: Counter[str] = field(default_factory=Counter)
    """Rows of `scenes` that were read."""
    instances: int = 0
    """Number of different objects; what they stand on is not counted."""
    views: int = 0
    pairs: int = 0
    files: int = 0
    bytes: int = 0
    seconds: float = 0.0
    visibility: dict[str, Histogram] = field(default_factory=dict)
    """By role."""
    inclination: dict[str, Histogram] = field(default_factory=dict)
    """By role, degrees below the horizontal."""
    distance: Histogram = field(default_factory=lambda: Histogram(*DISTANCE_M))
    """d_z of each pair, metres."""
    effects: dict[str, Cost] = field(default_factory=dict)
    """The costliest first."""
    stages: dict[str, Cost] = field(default_factory=dict)
    """The costliest first."""
    failures: tuple[Failure, ...] = ()

    @property
    def scenes(self) -> int:
        """Rows of `scenes` that were read."""
        return self.by_category.total()


def collect(tables: Tables) -> Figures:
    """The figures of all rows, read once, by columns."""
    figures = Figures(tables.sampled)
    _read_scenes(tables, figures)
    _read_views(tables, figures)
    _read_timings(tables, figures)
    figures.failures = _read_failures(tables)
    figures.instances = _count_instances(tables)
    figures.by_category = Counter(dict(sorted(figures.by_category.items())))
    figures.effects = dict(sorted(figures.effects.items(), key=lambda item: (-item[1].seconds, -item[1].runs, item[0])))
    figures.stages = dict(sorted(figures.stages.items(), key=lambda item: -item[1].seconds))
    return figures


def _read_scenes(tables: Tables, figures: Figures) -> None:
    columns = ("scene_id", "category", "effects", "skipped")
    for rows in tables.batches("scenes", columns):
        figures.by_category.update(_counts(rows.column("category")))
        for name, runs in _counts(_flat(rows, "effects")).items():
            figures.effects.setdefault(name, Cost()).runs += runs
        skipped = _flat(rows, "skipped")
        both = pc.binary_join_element_wise(pc.struct_field(skipped, "effect"), pc.struct_field(skipped, "why"), "\0")
        for reason, times in _counts(both).items():
            name, _, why = reason.partition("\0")
            figures.effects.setdefault(name, Cost()).skips[why] += times


def _read_views(tables: Tables, figures: Figures) -> None:
    for rows in tables.batches("views", ("role", "visible_fraction", "inclination_rad", "d_z_m", "files")):
        figures.views += rows.num_rows
        sizes = pc.struct_field(_flat(rows, "files"), "bytes")
        figures.files += len(sizes)
        figures.bytes += pc.sum(sizes).as_py() or 0
        for role in ("input", "mirror"):
            of = rows.filter(pc.field("role") == role)
            if not of.num_rows:
                continue
            visibility = figures.visibility.get(role, Histogram(0.0, 1.0))
            figures.visibility[role] = visibility.add(_numbers(of, "visible_fraction"))
            inclination = figures.inclination.get(role, Histogram(-96.0, 96.0))
            figures.inclination[role] = inclination.add(np.degrees(_numbers(of, "inclination_rad")))
            if role == "input":
                figures.pairs += of.num_rows
                figures.distance = figures.distance.add(_numbers(of, "d_z_m"))


def _read_timings(tables: Tables, figures: Figures) -> None:
    for rows in tables.batches("timings", ("stages", "effects", "total_s")):
        figures.seconds += float(_numbers(rows, "total_s").sum())
        for column, costs in (("stages", figures.stages), ("effects", figures.effects)):
            times = pa.table(pa.RecordBatch.from_struct_array(_flat(rows, column)))
            for row in times.group_by("name").aggregate([("seconds", "sum"), ("seconds", "count")]).to_pylist():
                if column == "stages" or row["name"] in costs:
                    cost = costs.setdefault(row["name"], Cost())
                    cost.seconds += row["seconds_sum"]
                    cost.timed += row["seconds_count"]


def _read_failures(tables: Tables) -> tuple[Failure, ...]:
    """Each way of failing, the most frequent first."""
    failures: dict[tuple[str, str, str], Failure] = {}
    for rows in tables.batches("failures", ("scene_id", "reason", "kind", "stage", "detail")):
        for row in rows.to_pylist():
            key = (row["reason"], row["kind"], row["stage"])
            failure = failures.setdefault(key, Failure(*key, 0, (), row["detail"]))
            examples = (*failure.examples, row["scene_id"])[:MOST_EXAMPLES]
            failures[key] = replace(failure, scenes=failure.scenes + 1, examples=examples)
    return tuple(sorted(failures.values(), key=lambda failure: -failure.scenes))


def _count_instances(tables: Tables) -> int:
    """Number of different objects; what they stand on is not counted."""
    seen: set[str] = set()
    for rows in tables.batches("assets", ("instance_id", "category")):
        objects = rows.filter(pc.invert(pc.is_in(rows.column("category"), value_set=pa.array(GROUNDS))))
        seen.update(objects.column("instance_id").to_pylist())
    return len(seen)


def _counts(values: pa.Array | pa.ChunkedArray) -> Counter[str]:
    return Counter({count["values"]: count["counts"] for count in pc.value_counts(values).to_pylist()})


def _flat(rows: pa.Table, column: str) -> pa.Array:
    """The items of a list column."""
    return pc.list_flatten(rows.column(column).combine_chunks())


def _numbers(rows: pa.Table, column: str) -> np.ndarray:
    """[N] float64, NaN for null."""
    values = rows.column(column).cast(pa.float64())
    return pc.fill_null(values, math.nan).to_numpy()
