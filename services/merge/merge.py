"""Merging of committed ranges into the finished dataset: strict, in constant memory, repeatable after a kill.

Two coordinators may merge at once: the lock is advice, and one that was paused wakes up late. Each merge ends in one
consistent dataset or in a refusal, because

- commits are only ever added: a merge is a function of its commits, and two merges of the same commits write the same;
- whoever lost the lock, or finds other commits than it began with, stops: asked before the merge, before it replaces the
  first file and before it writes `_SUCCESS`;
- should it be paused between question and step, the step itself fails. On a disk every file, `_SUCCESS` too, gets its
  name by a rename out of the merge's own folder, and loses it by one into that folder; the next merge takes this folder
  away in one step before it reads a commit. In an object store every put is conditional on what was listed before the
  question: what a later merge replaced is not replaced again. (A file that a later merge left as it was has the same
  rows in every merge between, because the rows that come before a row only become more.) A file that the later merge
does not have can still be put; the merge that put it is then refused at its next step, and empties it again.

What is left in an object store: a merge that is paused just before a put, while another takes the lock, commits and
merges, and that is then killed right after this put. It may leave a file too many, or, where the other is killed too, its
`_SUCCESS` over files of the other. Sizes and names in `_SUCCESS` do not agree then, so the next run merges again. Files
above `objects.CONDITIONAL_BYTES` are asked for and then put, not in one step.
"""

import contextlib
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from schemas.dataset.layout import CAM_POSES, CAMERAS, MANIFEST, OBJECTS, SUCCESS_FILE, is_shape
from schemas.dataset.tables import DETERMINISTIC_TABLES, SCHEMA_VERSION, SCHEMAS, TABLES
from schemas.errors import RunError, VersoError
from services.job.record import read_success
from services.merge.reading import Block, PublishedFiles, read_blocks
from services.merge.shared import SharedRows, merge_folder
from services.merge.tables import MergedTable, PoseFiles
from workers.store.attempt import sweep
from workers.store.canonical import dataset_digest
from workers.store.commit import commits_digest
from workers.store.file_system import sha256_of
from workers.store.manifest import PARQUET_OPTIONS
from workers.store.store import Entry, Store, map_ahead, stat_all


class Merging:
    """Takes every range in turn; keeps files below `folder`, which must be empty."""

    def __init__(self, folder: Path) -> None:
        self._tables = {table: MergedTable(table, folder) for table in TABLES}
        self._poses = PoseFiles(folder)
        self._shared = SharedRows(folder)
        self._fingerprints: set[str] = set()
        self._scenes = Counter({"made": 0, "intrinsic": 0, "environmental": 0})

    def add(self, block: Block) -> None:
        """Takes the next ranges. Raises CorruptError where rows do not join."""
        self._fingerprints.update(record.terms.fingerprint for record in chain.from_iterable(block.ranges))
        self._shared.add_files((entry.path, entry.sha256) for _, entry in block.files if is_shape(entry.path))
        rows = block.rows
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


class Installation:
    """Replaces an older merge by this one, file by file and `_SUCCESS` last; a context that undoes what it can on an error.

    `require_unchanged` raises RunError where another process works here. It is asked after what is there was listed, and
    before anything is replaced.
    """

    def __init__(self, store: Store, folder: Path, require_unchanged: Callable[[], None]) -> None:
        self._store = store
        self._folder = folder
        self._require_unchanged = require_unchanged
        self._new: dict[str, Entry] = {}
        """Objects that were put where there was nothing."""

    def __enter__(self) -> "Installation":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Where a merge is refused, rows of its new files must not stay beside a newer merge that does not have them."""
        if kind is None or not issubclass(kind, VersoError):
            return
        for key, mine in self._new.items():
            with contextlib.suppress(VersoError):
                if key.endswith(".parquet"):
                    self._store.replace(_empty_table(self._folder, key), key, mine)

    def put_files(self, files: Mapping[str, Path]) -> dict[str, dict[str, object]]:
        """Takes `_SUCCESS` away, then puts the files into their places; older ones that have no successor go.

        An object store cannot delete on a condition. There an empty table takes the place of such a file; the entries of
        these come back. Raises RunError where another merge replaced a file meanwhile.
        """
        store = self._store
        before = stat_all(store, _FOLDERS, [*_SINGLE, SUCCESS_FILE])
        self._require_unchanged()
        if before.pop(SUCCESS_FILE, None) is not None:
            if not store.withdraw(SUCCESS_FILE, self._folder):
                store.remove(SUCCESS_FILE)
            store.sync([SUCCESS_FILE])
        stale = sorted(before.keys() - files.keys())
        emptied = {}
        for key in stale:
            if not store.withdraw(key, self._folder):
                emptied[key] = _empty_table(self._folder, key)
        placed = {**emptied, **files}.items()
        for _ in map_ahead(store, lambda item: self._put(*item, before.get(item[0])), placed, at_once=AT_ONCE):
            pass
        store.sync([*files, *stale])
        return {key: file_entry(path) for key, path in emptied.items()}

    def put_success(self, data: bytes) -> None:
        """Writes `_SUCCESS`. Raises RunError where another merge wrote it, or took this merge's folder away."""
        local = self._folder / SUCCESS_FILE
        local.write_bytes(data)
        before = self._store.stat(SUCCESS_FILE)
        self._require_unchanged()
        self._store.replace(local, SUCCESS_FILE, before)

    def _put(self, key: str, local: Path, before: Entry | None) -> None:
        now = self._store.replace(local, key, before)
        if now is not None and before is None:
            self._new[key] = now


def sizes_agree(store: Store, files: Mapping[str, Mapping[str, object]]) -> bool:
    """Whether these files are there with their sizes, and no others where merged files are."""
    found = stat_all(store, _FOLDERS, _SINGLE)
    return {key: entry.bytes for key, entry in found.items()} == {key: file["bytes"] for key, file in files.items()}


def _empty_table(folder: Path, key: str) -> Path:
    """A file with the schema of the table that `key` belongs to."""
    table = key.split("/")[1]
    schema = SCHEMAS[table]
    path = folder / f"empty-{table}.parquet"
    pq.write_table(schema.remove(schema.get_field_index("category")).empty_table(), path, **PARQUET_OPTIONS)
    return path


@dataclass(frozen=True)
class MergeResult:
    """The contents of the merged dataset; `complete` says whether `_SUCCESS` was written."""

    digest: str
    complete: bool
    scenes: dict[str, int]
    """How many were made, and how many failed by kind."""
    rows: dict[str, int]
    """By table."""


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
    commits = commits_digest(store)
    asked = {"first_scene": first_scene, "stop_scene": stop_scene, "commits": commits}
    if (done := _merged_already(store, asked)) is not None:
        with merge_folder(store):
            pass  # what a killed merge left goes
        return _result(done)

    def require_unchanged() -> None:
        require_lock()
        if commits_digest(store) != commits:
            raise RunError("ranges were committed while they were merged: another coordinator works here; start again")

    require_lock()
    sweep(store)
    with merge_folder(store) as folder:
        with contextlib.closing(Merging(folder)) as merging, contextlib.closing(PublishedFiles(store, folder)) as files:
            for block in read_blocks(store, first_scene, stop_scene):
                files.check(block)
                merging.add(block)
            success, merged = merging.finish()
        with Installation(store, folder, require_unchanged) as installation:
            success["files"] |= installation.put_files(merged)
            if success["scenes"]["environmental"]:
                require_unchanged()
            else:
                installation.put_success(encode_success(success | asked))
    return _result(success)


def encode_success(success: Mapping[str, object]) -> bytes:
    """The bytes of `_SUCCESS`."""
    return json.dumps(success, sort_keys=True, indent=1).encode() + b"\n"


def _merged_already(store: Store, asked: Mapping[str, object]) -> dict | None:
    """The contents of `_SUCCESS` where it is of these very commits and all its files are there."""
    done = read_success(store)
    if done is None or any(done.get(key) != value for key, value in asked.items()):
        return None
    return done if sizes_agree(store, done["files"]) else None


def _result(success: Mapping[str, Any]) -> MergeResult:
    complete = not success["scenes"]["environmental"]
    return MergeResult(success["digest"], complete, success["scenes"], success["rows"])
