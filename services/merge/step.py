"""Merging of committed ranges into the finished dataset: strict, in constant memory, repeatable after a kill."""

import contextlib
import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from schemas.dataset.layout import MANIFEST, SUCCESS_FILE, is_merged_path, is_shape
from schemas.dataset.tables import DETERMINISTIC_TABLES, SCHEMA_VERSION, TABLES
from schemas.errors import RunError
from services.merge.poses import PoseFiles
from services.merge.published import PublishedFiles
from services.merge.reading import Block, read_blocks
from services.merge.shared import SharedRows
from services.merge.tables import MergedTable
from workers.store.canonical import dataset_digest
from workers.store.commit import commits_digest
from workers.store.store import Store
from workers.store.sweep import sweep


@dataclass(frozen=True)
class MergeResult:
    """The contents of the merged dataset; `complete` says whether `_SUCCESS` was written."""

    digest: str
    complete: bool
    scenes: dict[str, int]
    """How many were made, and how many failed by kind."""
    rows: dict[str, int]
    """By table."""


def merge(store: Store, first_scene: int, stop_scene: int) -> MergeResult:
    """Writes manifest/<table>/, camPoses.csv, cameras.csv and objects.dat, then `_SUCCESS`.

    Every scene of [first_scene, stop_scene) must be committed exactly once. `_SUCCESS` is withheld while environmental
    failures remain. A dataset that is already merged is left as it is.

    Raises RunError naming the scenes that are missing, CorruptError naming a file that does not match its commit,
    CommitConflict where ranges made one shape differently.
    """
    commits = commits_digest(store)
    asked = {"first_scene": first_scene, "stop_scene": stop_scene, "commits": commits}
    if (done := _merged_already(store, asked)) is not None:
        return _result(done)
    reopen(store)
    sweep(store)
    with store.scratch("merge") as folder:
        with (
            contextlib.closing(PublishedFiles(store, folder)) as published,
            contextlib.closing(Merging(folder)) as merging,
        ):
            for block in read_blocks(store, first_scene, stop_scene):
                published.check(block)
                merging.add(block)
            success, files = merging.finish()
        _install(store, files)
    if commits_digest(store) != commits:
        raise RunError("ranges were committed while they were merged: another coordinator works here; start again")
    if not success["scenes"]["environmental"]:
        store.write_whole(SUCCESS_FILE, encode_success(success | asked))
    return _result(success)


def reopen(store: Store) -> None:
    """Removes `_SUCCESS`: the first step of an extension, a retry and a merge."""
    store.remove(SUCCESS_FILE)
    store.sync_folders_of([SUCCESS_FILE])


def encode_success(success: Mapping[str, object]) -> bytes:
    """The bytes of `_SUCCESS`."""
    return json.dumps(success, sort_keys=True, indent=1).encode() + b"\n"


def read_success(store: Store) -> dict | None:
    """The contents of `_SUCCESS`, None where there is none or it is not whole."""
    try:
        success = json.loads(store.read(SUCCESS_FILE))
    except (FileNotFoundError, ValueError):
        return None
    return success if _is_whole(success) else None


def _is_whole(success: object) -> bool:
    """Whether the keys that readers of `_SUCCESS` use are of their types, and its files those that a merge writes."""
    kinds = {"schema_version": int, "digest": str, "files": dict, "scenes": dict, "rows": dict}
    if not isinstance(success, dict) or any(not isinstance(success.get(key), kind) for key, kind in kinds.items()):
        return False
    files = success["files"].items()
    named = all(is_merged_path(path) and isinstance(file, dict) and "bytes" in file for path, file in files)
    return named and "environmental" in success["scenes"]


class Merging:
    """A merge in progress: takes each range in turn, keeps files below `folder`."""

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
        """Closes every file, finished or not."""
        for part in (self._poses, self._shared):
            part.close()

    def finish(self) -> tuple[dict, dict[str, Path]]:
        """The contents of `_SUCCESS`, and the finished files by key."""
        mixed = len(self._fingerprints) > 1
        for rows in self._shared.assets(mixed):
            self._tables["assets"].add(rows)
        categories = sorted(self._tables["scenes"].categories | self._tables["failures"].categories)
        self._poses.close()
        files = self._poses.paths
        for table in self._tables.values():
            files = files | table.finish(categories)
        entries = {path: _entry(local) for path, local in sorted(files.items())}
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


def _install(store: Store, files: Mapping[str, Path]) -> None:
    """Replaces an older merge file by file, while there is no `_SUCCESS`."""
    for table in TABLES:
        for old in list(store.files(f"{MANIFEST}/{table}")):
            if old.key not in files:
                store.remove(old.key)
                store.remove_empty(old.key.rpartition("/")[0])
    for key, local in files.items():
        store.install(local, key)
    store.sync_folders_of(files)


def _merged_already(store: Store, asked: Mapping[str, object]) -> dict | None:
    """The contents of `_SUCCESS` where it is of these very commits and all its files are there."""
    done = read_success(store)
    if done is None or any(done.get(key) != value for key, value in asked.items()):
        return None
    return done if all(store.size(path) == file["bytes"] for path, file in done["files"].items()) else None


def _entry(path: Path) -> dict[str, object]:
    with open(path, "rb") as file:
        return {"bytes": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def _result(success: Mapping[str, Any]) -> MergeResult:
    complete = not success["scenes"]["environmental"]
    return MergeResult(success["digest"], complete, success["scenes"], success["rows"])
