"""A dataset opened in Python: its tables as pyarrow datasets, and its pairs one after the other.

from services.dataset.dataset import open_dataset

for pair in open_dataset("data/tabletop").pairs(pc.field("category") == "mug"):
depth_m = pair.mirror.depth_m()
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.dataset.tables import CAPTURE_SCHEMAS, SCHEMAS, TABLES
from schemas.errors import InputError
from schemas.job.job import Job
from schemas.nearest import did_you_mean
from services.dataset.pair import Pair, read_pair
from services.dataset.pair_table import PAIR_TABLES, choose_pairs, pair_table
from services.dataset.stored_files import RangeFiles, StoredFiles
from services.job.record import require_job
from services.merge.merge import read_success
from services.read.dataset_reader import find_records
from services.read.stored_tables import StoredTables
from workers.store.ledger import iter_committed, range_rows
from workers.store.store import Store, open_store

KEPT_RANGES = 8
"""Ranges whose rows are kept for reading pairs in any order."""

Records = Sequence[CommitRecord]


def open_dataset(place: str | Path) -> "Dataset":
    """The dataset in a folder, or in a bucket such as s3://bucket/path; finished or being made, scenes or captures.

    Reads job.yaml alone. Raises OutputError where there is no dataset.
    """
    return Dataset(open_store(str(place)))


class Dataset:
    """Stored pairs and tables. Nothing is kept between calls but the last files; a process may hold many."""

    def __init__(self, store: Store) -> None:
        record = require_job(store)
        self._store = store
        self._files = StoredFiles(store, record)
        self.place = store.name
        self.job: Job = record.job
        """The job that made it, every default filled in."""
        self._range_of = lru_cache(KEPT_RANGES)(self._read_range)

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
        if name not in TABLES:
            raise InputError(f"there is no table {name!r}; {did_you_mean(name, TABLES)}Tables are {', '.join(TABLES)}")
        return StoredTables(self._store).dataset(name)

    def pairs(self, where: pc.Expression | None = None, part: tuple[int, int] = (0, 1)) -> Iterator[Pair]:
        """Every pair for which `where` is true, in order of pose id, one range of scenes in memory at a time.

        `where` is a pyarrow expression over the columns of `pair_table`: those of `scenes`, the views by role as
        pc.field("input", "visible_fraction"), and the object's row of `assets` as pc.field("asset", "split"). `part`: (k, n)
        reads every n-th range from the k-th on, for n processes that share the work. Raises InputError for an expression
        that names other columns, and while it goes CorruptError where a file is damaged.
        """
        if not 0 <= part[0] < part[1]:
            raise InputError(f"part {part} must be (k, n) with 0 <= k < n")
        schemas = SCHEMAS if self.job.captures is None else CAPTURE_SCHEMAS
        choose_pairs(pair_table({table: schemas[table].empty_table() for table in PAIR_TABLES}), where)
        return self._pairs(where, part)

    def _pairs(self, where: pc.Expression | None, part: tuple[int, int]) -> Iterator[Pair]:
        for number, records in enumerate(iter_committed(self._store)):
            if number % part[1] == part[0]:
                yield from self._read_pairs(records, where)

    def pair(self, pose_id: int) -> Pair:
        """The pair with this id of its input view or of its mirror view. Raises InputError where it is not stored."""
        found = [pair for pair in self.scene(self._scene_of(pose_id)) if pair.pose_id == pose_id - pose_id % 2]
        if not found:
            raise InputError(
                f"{self.place} has no pair {pose_id}: `verso status {self.place}` tells which scenes are there"
            )
        return found[0]

    def scene(self, scene_id: int) -> tuple[Pair, ...]:
        """The pairs of one scene; none of a scene that failed. Raises InputError where it is not stored."""
        return tuple(self._read_pairs(self._range_of(scene_id), pc.field("scene_id") == scene_id))

    def _scene_of(self, pose_id: int) -> int:
        return pose_id // (2 * self.job.pairs_per_scene)

    def _read_range(self, scene_id: int) -> Records:
        return find_records(self._store, scene_id)

    def _read_pairs(self, records: Records, where: pc.Expression | None) -> Iterator[Pair]:
        table = choose_pairs(pair_table({name: range_rows(self._store, records, name) for name in PAIR_TABLES}), where)
        if not table.num_rows:
            return
        labels = _labels(range_rows(self._store, records, "objects"), table.column("scene_id"))
        files = RangeFiles(self._files, records)
        for number in np.argsort(table.column("parent_id").to_numpy()):
            yield read_pair(table.slice(number, 1).to_pylist()[0], labels, files)


def _labels(objects: pa.Table, scenes: pa.ChunkedArray) -> dict[tuple[int, str], list[Row]]:
    """Rows of `objects` of some scenes by (pose id, role)."""
    found: dict[tuple[int, str], list[Row]] = defaultdict(list)
    for row in objects.filter(pc.is_in(objects.column("scene_id"), scenes.combine_chunks())).to_pylist():
        found[row["pose_id"], row["role"]].append(row)
    return found
