"""Merging of committed ranges into the finished dataset: strict, in constant memory, repeatable after a kill.

Two coordinators may merge at once: the lock is advice, and one that was paused wakes up late. Each merge ends in one
consistent dataset or in a refusal, because commits are only ever added, two merges of the same commits write the same, and
whoever lost the lock, or finds other commits than it began with, stops: asked before the merge, before it replaces the first
file and before it writes `_SUCCESS`. Should it be paused between question and step, the step itself fails.

- On a disk every file gets its name by a rename out of the merge's own folder, and loses it by one into that folder, which
  the next merge takes away in one step before it reads a commit.
- In an object store every put is conditional on what was listed before the question. A file that the later merge does not
  have can still be put; the merge that put it is then refused at its next step, and empties it again. Where it is killed
  right after this put, a file too many may stay, or, where the other is killed too, its `_SUCCESS` over files of the other:
  sizes and names in `_SUCCESS` do not agree then, so the next run merges again. Files above `objects.CONDITIONAL_BYTES` are
  asked for and then put, not in one step.
"""

import contextlib
import json
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.layout import (
    CAM_POSES,
    CAMERAS,
    MANIFEST,
    OBJECTS,
    SUCCESS_FILE,
    is_shape,
)
from schemas.dataset.tables import DETERMINISTIC_TABLES, SCHEMA_VERSION, SCHEMAS, TABLES
from schemas.errors import RunError, VersoError
from services.job.record import read_success
from services.merge.reading import RangeRows, SharedRows, check_published, merge_folder, read_ranges, stored_sizes
from services.merge.tables import MergedTable, MergeResult, PoseFiles
from workers.store.attempt import sweep
from workers.store.commit import commits_digest
from workers.store.file_system import sha256_of
from workers.store.manifest import PARQUET_OPTIONS, dataset_digest, join_rows
from workers.store.store import Entry, Store, map_ahead, stat_all

RANGES_PER_BLOCK = 128
ROWS_PER_BLOCK = 4_096
"""A block ends with either of them, rows of all tables counted: small enough for memory, large enough to be fast."""


class Merging:
    """Takes every range in turn, and joins their rows in blocks; keeps files below `folder`, which must be empty."""

    def __init__(self, folder: Path) -> None:
        self._tables = {table: MergedTable(table, folder) for table in TABLES}
        self._poses = PoseFiles(folder)
        self._shared = SharedRows(folder)
        self._fingerprints: set[str] = set()
        self._scenes = Counter({"made": 0, "intrinsic": 0, "environmental": 0})
        self._block: list[Mapping[str, pa.Table]] = []

    def add(self, read: RangeRows) -> None:
        """Takes the next range. Raises CorruptError where rows do not join."""
        self._fingerprints.update(record.terms.fingerprint for record in read.records)
        self._shared.add_files((entry.path, entry.sha256) for entry in read.files if is_shape(entry.path))
        self._block.append(read.rows)
        rows = sum(len(table) for tables in self._block for table in tables.values())
        if len(self._block) >= RANGES_PER_BLOCK or rows >= ROWS_PER_BLOCK:
            self._end_block()

    def _end_block(self) -> None:
        block, self._block = self._block, []
        if not block:
            return
        parts = {table: [tables[table] for tables in block if table in tables] for table in TABLES}
        rows = {table: join_rows(table, parts[table]).combine_chunks() for table in TABLES}
        self._shared.add_assets(rows["assets"])
        self._shared.add_images(rows["views"])
        self._poses.add(rows["views"], rows["objects"])
        for table in TABLES:
            if table != "assets":
                self._tables[table].add(rows[table])
        self._scenes.update(made=rows["scenes"].num_rows, **Counter(rows["failures"].column("kind").to_pylist()))

    def close(self) -> None:
        """Closes what is open, finished or not."""
        self._shared.close()

    def finish(self) -> tuple[dict, dict[str, Path]]:
        """The contents of `_SUCCESS`, and the finished files by key."""
        self._end_block()
        mixed = len(self._fingerprints) > 1
        for rows in self._shared.assets(mixed):
            self._tables["assets"].add(rows)
        categories = sorted(self._tables["scenes"].categories | self._tables["failures"].categories)
        files = self._poses.paths
        for table in self._tables.values():
            files = files | table.finish(categories)
        entries = {path: file_entry(local) for path, local in sorted(files.items())}
        self._shared.add_files((path, str(entries[path]["sha256"])) for path in self._poses.paths)
        digests = {table: merged.digest.hexdigest() for table, merged in self._tables.items()}
        success = {
            "schema_version": SCHEMA_VERSION,
            "digest": dataset_digest(digests, self._shared.files(mixed)),
            "tables": {table: digests[table] for table in DETERMINISTIC_TABLES},
            "files": entries,
            "rows": {table: merged.digest.rows for table, merged in self._tables.items()},
            "scenes": dict(self._scenes),
            "images": self._shared.images,
            "fingerprints": sorted(self._fingerprints),
        }
        return success, files


_FOLDERS = tuple(f"{MANIFEST}/{table}" for table in TABLES)
_SINGLE = (CAM_POSES, CAMERAS, OBJECTS)

AT_ONCE = 4
"""Files that are put at once into an object store; each is in memory meanwhile."""


def file_entry(path: Path) -> dict[str, object]:
    """Size and SHA-256 of a file, as `_SUCCESS` has them."""
    with open(path, "rb") as file:
        return {"bytes": path.stat().st_size, "sha256": sha256_of(file)}


def install(
    store: Store, folder: Path, files: Mapping[str, Path], success: dict, require_unchanged: Callable[[], None]
) -> None:
    """Replaces an older merge by this one, file by file; `_SUCCESS` goes first and comes last, unless scenes are to be retried.

    `require_unchanged` raises RunError where another process works here. It is asked after what is there was listed, and
    before anything is replaced. Raises RunError too where another merge replaced a file meanwhile.
    """
    new: dict[str, Entry] = {}
    try:
        success["files"] |= put_files(store, folder, files, new, require_unchanged)
        local = folder / SUCCESS_FILE
        local.write_bytes(encode_success(success))
        before = store.stat(SUCCESS_FILE)
        require_unchanged()
        if not success["scenes"]["environmental"]:
            store.replace(local, SUCCESS_FILE, before)
    except VersoError:
        # Rows of this merge's new files must not stay beside a newer merge that does not have them.
        for key, mine in new.items():
            with contextlib.suppress(VersoError):
                if key.endswith(".parquet"):
                    store.replace(_empty_table(folder, key), key, mine)
        raise


def put_files(
    store: Store, folder: Path, files: Mapping[str, Path], new: dict[str, Entry], require_unchanged: Callable[[], None]
) -> dict[str, dict[str, object]]:
    """Takes `_SUCCESS` away, then puts the files into their places; older ones that have no successor go.

    An object store cannot delete on a condition. There an empty table takes the place of such a file; the entries of
    these come back. `new` gets the objects that are put where there was nothing.
    """
    before = stat_all(store, _FOLDERS, [*_SINGLE, SUCCESS_FILE])
    require_unchanged()
    if before.pop(SUCCESS_FILE, None) is not None:
        if not store.withdraw(SUCCESS_FILE, folder):
            store.remove(SUCCESS_FILE)
        store.sync([SUCCESS_FILE])
    stale = sorted(before.keys() - files.keys())
    emptied = {key: _empty_table(folder, key) for key in stale if not store.withdraw(key, folder)}
    placed = {**emptied, **files}

    def put(key: str) -> None:
        entry = store.replace(placed[key], key, before.get(key))
        if entry is not None and key not in before:
            new[key] = entry

    for _ in map_ahead(store, put, placed, at_once=AT_ONCE):
        pass
    store.sync([*files, *stale])
    return {key: file_entry(path) for key, path in emptied.items()}


def _empty_table(folder: Path, key: str) -> Path:
    """A file with the schema of the table that `key` belongs to."""
    table = key.split("/")[1]
    path = folder / f"empty-{table}.parquet"
    pq.write_table(SCHEMAS[table].empty_table().drop_columns("category"), path, **PARQUET_OPTIONS)
    return path


def merge(
    store: Store, first_scene: int, stop_scene: int, require_lock: Callable[[], None] = lambda: None
) -> MergeResult:
    """Writes manifest/<table>/, camPoses.csv, cameras.csv and objects.dat, then `_SUCCESS`.

    Every scene of [first_scene, stop_scene) must be committed exactly once. `_SUCCESS` is withheld while environmental
    failures remain. A dataset that is already merged is left as it is, and so is an older merge until every new file is
    written.

    `require_lock` raises RunError where the lock was lost. Raises RunError naming the scenes that are missing or where
    another process works here, CorruptError naming a file that does not match its commit, CommitConflict where ranges
    made one shape differently, MachineError where a disk is full.
    """
    asked = {"first_scene": first_scene, "stop_scene": stop_scene, "commits": commits_digest(store)}
    done = _merged_already(store, asked)
    if done is None:
        require_lock()
        sweep(store)
    with merge_folder(store) as folder:  # what a killed merge left goes
        success = done or _merge_anew(store, folder, asked, require_lock)
    return MergeResult(success["digest"], success["scenes"], success["rows"])


def _merge_anew(
    store: Store, folder: Path, asked: Mapping[str, Any], require_lock: Callable[[], None]
) -> dict[str, Any]:
    """Merges what is `asked`; the contents of `_SUCCESS`."""

    def require_unchanged() -> None:
        require_lock()
        if commits_digest(store) != asked["commits"]:
            raise RunError("ranges were committed while they were merged: another coordinator works here; start again")

    with contextlib.closing(Merging(folder)) as merging, stored_sizes(store, folder) as size_of:
        for read in read_ranges(store, asked["first_scene"], asked["stop_scene"]):
            check_published(read, size_of)
            merging.add(read)
        success, files = merging.finish()
    success |= asked
    install(store, folder, files, success, require_unchanged)
    return success


def encode_success(success: Mapping[str, object]) -> bytes:
    """The bytes of `_SUCCESS`."""
    return json.dumps(success, sort_keys=True, indent=1).encode() + b"\n"


def _merged_already(store: Store, asked: Mapping[str, object]) -> dict | None:
    """The contents of `_SUCCESS` where it is of these very commits, and its files are there with their sizes, and no others."""
    done = read_success(store)
    if done is None or not asked.items() <= done.items():
        return None
    sizes = {key: entry.bytes for key, entry in stat_all(store, _FOLDERS, _SINGLE).items()}
    return done if sizes == {key: file["bytes"] for key, file in done["files"].items()} else None
