"""From committed ranges to the finished dataset: strict, in constant memory, repeatable after a kill at any point."""

import contextlib
import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import MANIFEST, STAGING, SUCCESS_FILE
from schemas.dataset.tables import DETERMINISTIC_TABLES, SCHEMA_VERSION, TABLES
from schemas.errors import CorruptError, RunError
from services.merge.committed_rows import iter_ranges, range_rows
from services.merge.digest import dataset_digest
from services.merge.poses import PoseFiles
from services.merge.shared import AssetRows, FileList
from services.merge.tables import MergedTable
from workers.store.commit import check_published, commit_names
from workers.store.store import Store
from workers.store.sweep import sweep

_SCRATCH = "merge"


@dataclass(frozen=True)
class MergeResult:
    """What the merged dataset holds; `complete` says whether `_SUCCESS` was written."""

    digest: str
    complete: bool
    scenes: dict[str, int]
    """How many were made, and how many failed by kind."""
    rows: dict[str, int]
    """By table."""


def merge(store: Store, first_scene: int, stop_scene: int) -> MergeResult:
    """Writes manifest/<table>/, camPoses.csv, cameras.csv and objects.dat, then `_SUCCESS`.

    Every scene of [first_scene, stop_scene) must be committed exactly once. `_SUCCESS` is withheld while environmental
    failures remain. A dataset that is merged already is left as it is.

    Raises RunError naming the scenes that are missing, CorruptError naming a file that does not match its commit,
    CommitConflict where ranges made one shape differently.
    """
    commits = _commits_digest(store)
    asked = {"first_scene": first_scene, "stop_scene": stop_scene, "commits": commits}
    if (done := _merged_already(store, asked)) is not None:
        return _result(done)
    reopen(store)
    sweep(store)
    store.remove_tree(f"{STAGING}/_{_SCRATCH}")
    with store.scratch(_SCRATCH) as folder:
        with contextlib.closing(_Merging(store, folder)) as merging:
            for records in iter_ranges(store, first_scene, stop_scene):
                merging.add_range(records)
            success, files = merging.finish()
        _install(store, files)
    if _commits_digest(store) != commits:
        raise RunError("ranges were committed while they were merged: another coordinator works here; start again")
    success |= asked
    if not success["scenes"]["environmental"]:
        store.write_whole(SUCCESS_FILE, json.dumps(success, sort_keys=True, indent=1).encode() + b"\n")
    return _result(success)


def reopen(store: Store) -> None:
    """Takes `_SUCCESS` away: what an extension, a retry and a merge do first."""
    store.remove(SUCCESS_FILE)
    store.sync_folders_of([SUCCESS_FILE])


def read_success(store: Store) -> dict | None:
    """The contents of `_SUCCESS`, None where there is none or it is not whole."""
    try:
        success = json.loads(store.read(SUCCESS_FILE))
    except (FileNotFoundError, ValueError):
        return None
    return success if isinstance(success, dict) and isinstance(success.get("schema_version"), int) else None


class _Merging:
    """One merge under way: every table and file takes each range in turn."""

    def __init__(self, store: Store, folder: Path) -> None:
        self._store = store
        runs = folder / "runs"
        runs.mkdir()
        self._tables = {table: MergedTable(table, folder) for table in TABLES}
        self._poses = PoseFiles(folder)
        self._assets = AssetRows(runs)
        self._files = FileList(runs)
        self._fingerprints: set[str] = set()
        self._scenes = Counter({"made": 0, "intrinsic": 0, "environmental": 0})

    def add_range(self, records: Sequence[CommitRecord]) -> None:
        """Takes the next range with its retries. Raises CorruptError where they are not what was committed."""
        for record in records:
            check_published(self._store, record)
            self._files.add_shapes(record)
            self._fingerprints.add(record.terms.fingerprint)
        rows = {table: range_rows(self._store, records, table) for table in TABLES}
        self._assets.add(rows["assets"])
        self._files.add_images(rows["views"])
        self._poses.add(rows["views"], rows["objects"])
        for table in TABLES:
            if table != "assets":
                self._tables[table].add(rows[table])
        failed = rows["failures"].column("kind").to_pylist()
        self._scenes.update(made=rows["scenes"].num_rows, **Counter(failed))
        ids = rows["scenes"].column("scene_id").to_pylist() + rows["failures"].column("scene_id").to_pylist()
        if sorted(ids) != list(records[0].span.scene_ids):
            raise CorruptError(f"the rows of the range from scene {records[0].span.start} do not hold each scene once")

    def close(self) -> None:
        """Closes every file, finished or not."""
        self._poses.close()
        for table in self._tables.values():
            table.close()

    def finish(self) -> tuple[dict, dict[str, Path]]:
        """What `_SUCCESS` will say, and the finished files by key."""
        mixed = len(self._fingerprints) > 1
        for rows in self._assets.batches(mixed):
            self._tables["assets"].add(rows)
        categories = sorted({*self._tables["scenes"].categories, *self._tables["failures"].categories})
        pose_files = self._poses.finish()
        entries = {path: _entry(local) for path, local in pose_files.items()}
        for path, entry in entries.items():
            self._files.add(path, str(entry["sha256"]))
        files = dict(pose_files)
        for table in TABLES:
            files |= self._tables[table].finish(categories)
        digests = {table: merged.digest.hexdigest() for table, merged in self._tables.items()}
        success = {
            "schema_version": SCHEMA_VERSION,
            "digest": dataset_digest(digests, self._files.pairs(mixed)),
            "tables": {table: digests[table] for table in DETERMINISTIC_TABLES},
            "files": {path: entries.get(path) or _entry(local) for path, local in sorted(files.items())},
            "rows": {table: merged.digest.rows for table, merged in self._tables.items()},
            "scenes": dict(self._scenes),
            "images": self._files.images,
            "fingerprints": sorted(self._fingerprints),
        }
        return success, files


def _install(store: Store, files: Mapping[str, Path]) -> None:
    """Replaces an older merge file by file; `_SUCCESS` is away meanwhile."""
    for table in TABLES:
        for old in list(store.files(f"{MANIFEST}/{table}")):
            if old.key not in files:
                store.remove(old.key)
                store.remove_empty(old.key.rpartition("/")[0])
    for key, local in files.items():
        store.install(local, key)
    store.sync_folders_of(files)


def _merged_already(store: Store, asked: Mapping[str, object]) -> dict | None:
    """The contents of `_SUCCESS` where it stands for these very commits and all that it names is there."""
    done = read_success(store)
    if done is None or any(done.get(key) != value for key, value in asked.items()):
        return None
    return done if all(store.size(path) == file["bytes"] for path, file in done["files"].items()) else None


def _commits_digest(store: Store) -> str:
    """Tells one set of commits from another: a record never changes, so names and sizes are enough."""
    total = hashlib.sha256()
    for _, _, key in commit_names(store):
        total.update(f"{key} {store.size(key)}\n".encode())
    return total.hexdigest()


def _entry(path: Path) -> dict[str, object]:
    with open(path, "rb") as file:
        return {"bytes": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def _result(success: Mapping[str, dict]) -> MergeResult:
    return MergeResult(
        digest=str(success["digest"]),
        complete=not success["scenes"]["environmental"],
        scenes=dict(success["scenes"]),
        rows=dict(success["rows"]),
    )
