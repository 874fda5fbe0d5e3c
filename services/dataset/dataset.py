"""A dataset opened in Python: its tables as pyarrow datasets, and its pairs one after the other.

A choice of pairs is one expression over one Arrow table a range, which has the columns of scenes, views and assets. `verso.open`
is the door to this file. Splits of instances have shares that hold within each category. `make_scene` makes the pairs of one
scene in this process and keeps them in memory: no Ray, no folder.
"""

import copy
import hashlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
from cachetools import LRUCache

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import view_name
from schemas.dataset.tables import SCHEMAS
from schemas.errors import CorruptError, InputError, SceneError, command_line, needs_making
from schemas.job.assets import NO_SPLIT, SPLITS, SplitShares
from schemas.job.job import Job
from schemas.job.views import Patch
from schemas.scene.scene import SceneOutput
from schemas.scene.view import ROLES
from services.dataset.pair import Pair, read_pair
from services.dataset.shapes import RangeFiles, Shapes, StoredFiles
from services.dataset.view import Files
from services.job.record import JobRecord, read_success, record_job, require_job
from services.read.columns_page import require_table
from services.read.dataset_reader import StoredTables, find_records
from workers.store.ledger import iter_committed, range_rows
from workers.store.local import open_store
from workers.store.manifest import table_of_rows
from workers.store.store import Store

MOST_INSTANCES = 10_000
"""Instances of a category that are put in order; of more, the column of `assets` has the shares within 1 %."""


@dataclass(frozen=True)
class Splits:
    """The splits of a dataset's instances."""

    by_id: Mapping[str, str]
    """train, val, test or unseen; of instances that are not here, the column of `assets` holds."""
    held_out: frozenset[str] = frozenset()
    """Categories that are all in test."""

    def of(self, asset: Row) -> str:
        """The split of a row of `assets`."""
        if asset["category"] in self.held_out:
            return "test"
        return self.by_id.get(asset["instance_id"], asset["split"])


def strictest(splits: Iterable[str]) -> str:
    """The split of a scene whose objects are of these, so that no scene of `train` shows an object of `test`."""
    return max(splits, key=(*SPLITS, NO_SPLIT).index)


def collect_ids(batches: Iterable[Iterable[Row]]) -> dict[str, set[str] | None]:
    """The instance ids of each category in rows of `assets`; None where there are more than `MOST_INSTANCES`."""
    by_category: dict[str, set[str] | None] = {}
    for row in (row for rows in batches for row in rows):
        ids = by_category.setdefault(row["category"], set())
        if ids is not None:
            ids.add(row["instance_id"])
            if len(ids) > MOST_INSTANCES:
                by_category[row["category"]] = None
    return by_category


def split_by_category(instances: Mapping[str, Collection[str] | None], shares: SplitShares) -> dict[str, str]:
    """The split of every instance; `instances`: ids by category, as `collect_ids` has them.

    A category's instances stand in the order of their ids' hashes, as in `assets.split`, and are cut where the shares say;
    as long as there are enough, train has one, then test, then val. The same ids give the same splits. Those that the job
    names are where it names them.
    """
    if shares.named:
        return {name: shares.of(name) for names in instances.values() for name in names or ()}
    splits: dict[str, str] = {}
    for names in instances.values():
        order = sorted(names or (), key=lambda name: hashlib.sha256(name.encode()).digest())
        room = len(order) - (shares.train > 0)
        test = max(min(max(round(len(order) * shares.test), shares.test > 0), room), 0)
        val = max(min(max(round(len(order) * shares.val), shares.val > 0), room - test), 0)
        train = len(order) - val - test if shares.train else 0
        kinds = ["train"] * train + ["val"] * (len(order) - train - test) + ["test"] * test
        splits |= dict(zip(order, kinds, strict=True))
    return splits


PAIR_TABLES = ("scenes", "views", "assets")
"""The tables that a choice of pairs reads."""


def pair_table(rows: Mapping[str, pa.Table]) -> pa.Table:
    """One row for each pair, by the pose id of its input view (`parent_id`).

    Columns: those of `scenes`, `parent_id`, one struct for each role with the columns of `views` (null where there is no
    such view), and the struct `asset` with the columns of `assets` of the scene's (first) object.
    """
    views = rows["views"]
    parents = pa.chunked_array([pa.array(np.unique(views.column("parent_id").to_numpy()), pa.int64())])
    scene_of = views.column("scene_id").take(pc.index_in(parents, views["parent_id"]))
    scenes = rows["scenes"].take(pc.index_in(scene_of, rows["scenes"]["scene_id"]))
    table = scenes.append_column("parent_id", parents)
    for role in ROLES:
        table = table.append_column(role, _structs(views.filter(pc.field("role") == role), "parent_id", parents))
    return table.append_column("asset", _structs(rows["assets"], "instance_id", table.column("instance_id")))


def choose_pairs(table: pa.Table, where: pc.Expression | None) -> pa.Table:
    """The pairs for which `where` is true. Raises InputError naming what there is, where it names a column that is not."""
    if where is None:
        return table
    try:
        return table.filter(where)
    except (pa.ArrowException, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"the filter cannot be used: {reason[:200]}. Columns of a pair: {', '.join(table.column_names)}; those of a view "
            'or of the asset as pc.field("input", "visible_fraction") or pc.field("asset", "split")'
        ) from error


def _structs(table: pa.Table, key: str, values: pa.ChunkedArray) -> pa.ChunkedArray:
    """A struct of the first row with each of the values, null where there is none."""
    return table.to_struct_array().take(pc.index_in(values, table[key]))


KEPT_BYTES = 256 << 20
"""Rows of ranges that are kept for reading pairs in any order; the last range whatever its size."""


def open_dataset(place: str | Path) -> "Dataset":
    """The dataset in a folder, or in a bucket such as s3://bucket/path; finished or being made, scenes or captures.

    Reads job.yaml alone. Raises OutputError where there is no dataset.
    """
    return Dataset(open_store(str(place)))


class Dataset:
    """Stored pairs and tables. Between calls the last files, and rows of the last ranges, are kept; a process may hold many."""

    def __init__(self, store: Store) -> None:
        record = require_job(store)
        self._store = store
        self._files = StoredFiles(store, record)
        self.place = store.name
        self.job: Job = record.job
        """The job that made it, every default filled in."""
        self._kept: LRUCache[range, tuple[RangeRows, RangeFiles]] = LRUCache(
            KEPT_BYTES, lambda kept: min(kept[0].nbytes, KEPT_BYTES)
        )
        """The last ranges that were asked for a scene, by their scenes."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return open_dataset, (self.place,)

    @property
    def is_finished(self) -> bool:
        """Whether all scenes are made and merged."""
        return read_success(self._store) is not None

    def table(self, name: str) -> ds.Dataset:
        """One of scenes, views, objects, assets, failures and timings, as it is now; docs/columns.md tells the columns.

        Rows are read when it is scanned. In `assets` of an unfinished dataset an instance may stand several times. Raises
        InputError for another name.
        """
        require_table(name)
        return StoredTables(self._store).dataset(name)

    def splits(self, held_out: Sequence[str] = ()) -> dict[str, str]:
        """train, val or test of every object by its instance id, with the job's shares in each category, as exports have it.

        The objects of the categories in `held_out` are all in test. What a dataset holds decides: after an extension ask
        again. The column `split` of `assets` follows from the id alone.
        """
        rows = self.table("assets").to_table(columns=["instance_id", "category", "split"]).to_pylist()
        splits = Splits(split_by_category(collect_ids([rows]), self.job.assets.split), frozenset(held_out))
        return {row["instance_id"]: splits.of(row) for row in rows}

    def pairs(self, where: pc.Expression | None = None, part: tuple[int, int] = (0, 1)) -> Iterator[Pair]:
        """Every pair for which `where` is true, in order of pose id, one range of scenes in memory at a time.

        `where` is a pyarrow expression over the columns of `pair_table`: those of `scenes`, the views by role as
        pc.field("input", "visible_fraction"), and the object's row of `assets` as pc.field("asset", "split"). `part`: (k, n)
        reads every n-th range from the k-th on, for n processes that share the work. Raises InputError for an expression
        that names other columns, and while it goes CorruptError where a file is damaged.
        """
        if not 0 <= part[0] < part[1]:
            raise InputError(f"part {part} must be (k, n) with 0 <= k < n")
        choose_pairs(pair_table({table: SCHEMAS[table].empty_table() for table in PAIR_TABLES}), where)
        return self._pairs(where, part)

    def _pairs(self, where: pc.Expression | None, part: tuple[int, int]) -> Iterator[Pair]:
        for number, records in enumerate(iter_committed(self._store)):
            if number % part[1] == part[0]:
                yield from pairs_of(*self.open_range(records), where)

    def pair(self, pose_id: int) -> Pair:
        """The pair with this id of its input view or of its mirror view. Raises InputError where it is not stored."""
        scene_id = pose_id // (2 * self.job.pairs_per_scene)
        pairs = [pair for pair in self.scene(scene_id) if pair.pose_id == pose_id - pose_id % 2]
        if not pairs:
            raise InputError(
                f"{self.place} has no pair {pose_id}: `{command_line('status', self.place)}` tells which scenes are there"
            )
        return pairs[0]

    def scene(self, scene_id: int) -> tuple[Pair, ...]:
        """The pairs of one scene; none of a scene that failed. Raises InputError where it is not stored."""
        scenes = next((scenes for scenes in self._kept if scene_id in scenes), None)
        if scenes is None:
            records = find_records(self._store, scene_id)
            scenes = range(records[0].span.start, records[0].span.stop)
            self._kept[scenes] = self.open_range(records)
        rows, files = self._kept[scenes]
        return tuple(pairs_of(rows.of_scene(scene_id), files))

    def open_range(self, records: Sequence[CommitRecord]) -> "tuple[RangeRows, RangeFiles]":
        """The rows and files of a committed range."""
        return RangeRows.of(lambda table: range_rows(self._store, records, table)), RangeFiles(self._files, records)


@dataclass(frozen=True)
class RangeRows:
    """The rows of some scenes: `pair_table`, and those of `objects` and `assets`."""

    pairs: pa.Table
    more: pa.Table
    """Those of `views` of named cameras."""
    objects: pa.Table
    assets: pa.Table

    @classmethod
    def of(cls, rows: Callable[[str], pa.Table]) -> "RangeRows":
        """`rows` returns the scenes' rows of a table."""
        tables = {name: rows(name) for name in PAIR_TABLES}
        more = tables["views"].filter(pc.field("number").is_valid())
        return cls(pair_table(tables), more, rows("objects"), tables["assets"])

    def of_scene(self, scene_id: int) -> "RangeRows":
        """The same with the pairs of one scene, which stand together: a filter would copy them, which takes 1 ms."""
        at = np.flatnonzero(self.pairs.column("scene_id").to_numpy() == scene_id)
        return replace(self, pairs=self.pairs.slice(int(at[0]) if len(at) else 0, len(at)))

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return int(self.pairs.nbytes + self.more.nbytes + self.objects.nbytes + self.assets.nbytes)


_TOGETHER: Final = 16
"""Rows that become Python's objects together: in a sixth of the time that each takes by itself, and one scene keeps no more."""


def pairs_of(rows: RangeRows, files: Files, where: pc.Expression | None = None) -> Iterator[Pair]:
    """The pairs of some scenes for which `where` is true, by pose id."""
    table = choose_pairs(rows.pairs, where)
    if not table.num_rows:
        return
    chosen = rows.objects.filter(pc.is_in(rows.objects["scene_id"], table["scene_id"].combine_chunks()))
    named = rows.assets.filter(pc.is_in(rows.assets["instance_id"], chosen["instance_id"].combine_chunks()))
    assets, labels = (
        {row["instance_id"]: row for row in named.to_pylist()},
        defaultdict[tuple[int, str], list[Row]](list),
    )
    for row in chosen.to_pylist():
        name = view_name(row["role"], row["number"])
        labels[row["pose_id"], name].append(row | {"asset": assets[row["instance_id"]]})
    order = np.argsort(table.column("parent_id").to_numpy())
    table = table if (np.diff(order) == 1).all() else table.take(order)  # which copies all columns
    for row in (row for part in table.to_batches(max_chunksize=_TOGETHER) for row in part.to_pylist()):
        further = rows.more.filter(pc.field("parent_id") == row["parent_id"]).to_pylist() if len(rows.more) else ()
        yield read_pair(row, labels, files, further)


def make_scene(
    job: str | Path | Mapping[str, Any] | Job, scene_id: int, changes: Sequence[str] = ()
) -> tuple[Pair, ...]:
    """The pairs of one scene, the same to the byte as a run of the job stores them.

    `job`: a job file, or its keys, or a Job, with `changes` such as "start.pose=tumbled". Relative folders start from the job
    file, else from here. The first call of a process prepares the renderer. Raises JobError where the job is wrong,
    SceneError where this scene cannot be made, MachineError where what makes data is not installed.
    """
    with needs_making("verso.make_scene"):
        from workers.capture.results import open_sources
        from workers.scene.context import open_worker
        from workers.shard.run_shard import run_scene
        from workers.stopwatch import Stopwatch

    parsed, folder = _parse(job, changes)
    catalogue = open_sources(parsed, folder)
    output = run_scene(open_worker(parsed, catalogue), scene_id, Stopwatch())
    for row in output.rows.get("failures", ()):
        raise SceneError(str(row["reason"]), f"scene {scene_id} cannot be made ({row['stage']}): {row['detail']}")
    files = _MadeFiles(output, record_job(parsed, catalogue.digest, folder))
    return tuple(pairs_of(RangeRows.of(lambda table: table_of_rows(table, output.rows[table])), files))


def _parse(job: str | Path | Mapping[str, Any] | Job, changes: Sequence[str]) -> tuple[Job, Path]:
    """The job, and the folder that its relative paths start from."""
    from services.job.job_file import (  # what opens a dataset needs none of it
        change_key,
        load_job,
        validate_job,
        with_usual_colours,
    )

    if isinstance(job, str | Path):
        return load_job(Path(job), changes), Path(job).parent
    tree = job.model_dump(mode="json") if isinstance(job, Job) else copy.deepcopy(dict(job))
    for change in changes:
        change_key(tree, change)
    return validate_job(with_usual_colours(tree), "the job"), Path()


class _MadeFiles:
    """The encoded files of one scene."""

    def __init__(self, output: SceneOutput, record: JobRecord) -> None:
        self._data = {file.path: file.data for file in output.files}
        shapes = Shapes(self._shape, record)
        self.mesh, self.samples = shapes.mesh, shapes.samples
        self.patch: Patch = record.job.images.patch

    def _shape(self, path: str) -> bytes:
        if path not in self._data:
            raise FileNotFoundError(path)
        return self._data[path]

    def image(self, path: str) -> bytes:
        """The bytes of an image."""
        if path not in self._data:
            raise CorruptError(f"{path} was not made")
        return self._data[path]
