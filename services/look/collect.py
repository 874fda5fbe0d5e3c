"""The figures of a dataset from batches of its tables: rows of a large dataset are never all in memory."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from operator import itemgetter

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import MANIFEST
from schemas.dataset.tables import SCHEMAS
from services.job.record import read_success
from services.look.charts import Histogram
from services.read.dataset_reader import category_of
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
            parts = (part for key in self.merged if key.startswith(prefix) for part in self._merged(key, columns))
        else:
            parts = (range_rows(self.store, records, table) for records in self._records)
        for part in parts:
            if part.num_rows:
                yield _with_columns(part, table, columns)

    @cached_property
    def _records(self) -> list[list[CommitRecord]]:
        return [read_range(self.store, start, retries) for start, retries in self.ranges]

    def _merged(self, key: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        with self.store.open(key) as stored_file:
            file = pq.ParquetFile(stored_file, page_checksum_verification=True)
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
    schema = SCHEMAS[table]
    for name in columns:
        if name not in rows.column_names:
            rows = rows.append_column(name, pa.nulls(rows.num_rows, schema.field(name).type))
    return rows.select(list(columns))


@dataclass
class Cost:
    """How often something ran and what it took."""

    runs: int = 0
    seconds: float = 0.0
    timed: int = 0
    """How many of the runs have a time."""
    skips: Counter[str] = field(default_factory=Counter)
    """How often it was left out, by reason."""

    def add(self, seconds: float, times: int) -> None:
        """Takes times that were measured."""
        self.seconds += seconds
        self.timed += times


@dataclass(frozen=True)
class Failure:
    """Scenes that failed in one way, with an example."""

    reason: str
    kind: str
    stage: str
    scenes: int
    examples: tuple[int, ...]
    detail: str


@dataclass(frozen=True)
class CaptureQuality:
    """The figures of one capture; None where there is no truth to compare with."""

    scene_id: int
    name: str
    category: str
    views: int
    left_out: int
    estimate: str
    reprojection_px: float | None
    measured_share: float | None
    pose_mm: float | None
    cloud_median_mm: float | None
    completeness: float | None


GROUNDS = ("table", "board")
"""Categories of assets that objects stand on."""

MOST_EXAMPLES = 5
MOST_CAPTURES = 50
DISTANCE_M = (0.0, 9.6)
GAP_DECADES = (-6.0, 4.0)
"""Range of the resting gap, from a nanometre to ten metres, as a power of ten of a millimetre."""


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
    gap: Histogram = field(default_factory=lambda: Histogram(*GAP_DECADES))
    """Resting gaps of a nanometre and more, decimal logarithm of millimetres."""
    no_gap: int = 0
    """Scenes whose resting gap is less: none."""
    effects: dict[str, Cost] = field(default_factory=dict)
    """The costliest first."""
    stages: dict[str, Cost] = field(default_factory=dict)
    """The costliest first."""
    failures: tuple[Failure, ...] = ()
    captures: list[CaptureQuality] = field(default_factory=list)

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
    columns = ("scene_id", "category", "effects", "skipped", "hover_gap_mm", "capture")
    for rows in tables.batches("scenes", columns):
        figures.by_category.update(_counts(rows.column("category")))
        gap_mm = _numbers(rows, "hover_gap_mm")
        figures.no_gap += int((gap_mm < 10 ** GAP_DECADES[0]).sum())
        figures.gap = figures.gap.add(np.log10(gap_mm[gap_mm >= 10 ** GAP_DECADES[0]]))
        for name, runs in _counts(_flat(rows, "effects")).items():
            figures.effects.setdefault(name, Cost()).runs += runs
        skipped = _flat(rows, "skipped")
        both = pc.binary_join_element_wise(pc.struct_field(skipped, "effect"), pc.struct_field(skipped, "why"), "\0")
        for told, times in _counts(both).items():
            name, _, why = told.partition("\0")
            figures.effects.setdefault(name, Cost()).skips[why] += times
        figures.captures += _captures(rows, MOST_CAPTURES - len(figures.captures))


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
        for stage, one in _sums(rows, "stages"):
            cost = figures.stages.setdefault(stage, Cost())
            cost.add(*one)
            cost.runs = cost.timed
        for effect, one in _sums(rows, "effects"):
            if effect in figures.effects:
                figures.effects[effect].add(*one)


def _sums(rows: pa.Table, column: str) -> Iterator[tuple[str, tuple[float, int]]]:
    """(name, (seconds, how many)) of the times in a list column."""
    items = _flat(rows, column)
    named = pa.table({"name": pc.struct_field(items, "name"), "seconds": pc.struct_field(items, "seconds")})
    for one in named.group_by("name").aggregate([("seconds", "sum"), ("seconds", "count")]).to_pylist():
        yield one["name"], (one["seconds_sum"], one["seconds_count"])


def _read_failures(tables: Tables) -> tuple[Failure, ...]:
    """Each way of failing, the most frequent first."""
    counts: Counter[tuple[str, str, str]] = Counter()
    examples: dict[tuple[str, str, str], list[int]] = {}
    details: dict[tuple[str, str, str], str] = {}
    for rows in tables.batches("failures", ("scene_id", "reason", "kind", "stage", "detail")):
        for row in rows.to_pylist():
            key = (row["reason"], row["kind"], row["stage"])
            counts[key] += 1
            details.setdefault(key, row["detail"])
            if len(found := examples.setdefault(key, [])) < MOST_EXAMPLES:
                found.append(row["scene_id"])
    return tuple(Failure(*key, count, tuple(examples[key]), details[key]) for key, count in counts.most_common())


def _count_instances(tables: Tables) -> int:
    """Number of different objects; what they stand on is not counted."""
    seen: set[str] = set()
    unique = 0
    for rows in tables.batches("assets", ("instance_id", "category")):
        objects = rows.filter(pc.invert(pc.is_in(rows.column("category"), value_set=pa.array(GROUNDS))))
        if tables.merged:  # each stands there once
            unique += objects.num_rows
        else:
            seen.update(objects.column("instance_id").to_pylist())
    return unique + len(seen)


def _captures(rows: pa.Table, most: int) -> Iterator[CaptureQuality]:
    """The rows that are captures, at most so many."""
    column = rows.column("capture")
    if column.null_count == len(column):
        return
    for row in rows.select(["scene_id", "category", "capture"]).slice(0, max(most, 0)).to_pylist():
        if (one := row["capture"]) is not None:
            plain = ("reprojection_px", "measured_share", "pose_mm", "cloud_median_mm", "completeness")
            yield CaptureQuality(
                row["scene_id"], one["name"], row["category"], one["views"], len(one["left_out"]), one["estimate"],
                **{name: one[name] for name in plain},
            )  # fmt: skip


def _counts(values: pa.Array | pa.ChunkedArray) -> Counter[str]:
    return Counter({one["values"]: one["counts"] for one in pc.value_counts(values).to_pylist()})


def _flat(rows: pa.Table, column: str) -> pa.Array:
    """The items of a list column."""
    return pc.list_flatten(rows.column(column).combine_chunks())


def _numbers(rows: pa.Table, column: str) -> np.ndarray:
    """[N] float64, NaN for null."""
    values = rows.column(column).cast(pa.float64())
    return pc.fill_null(values, math.nan).to_numpy()
