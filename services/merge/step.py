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
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from schemas.dataset.layout import SUCCESS_FILE, is_merged_path
from schemas.errors import RunError
from services.merge.install import Installation, sizes_agree
from services.merge.merging import Merging
from services.merge.published import PublishedFiles
from services.merge.reading import read_blocks
from services.merge.scratch import SCRATCH, merge_folder
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
        store.drop_scratch(SCRATCH)
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


def _merged_already(store: Store, asked: Mapping[str, object]) -> dict | None:
    """The contents of `_SUCCESS` where it is of these very commits and all its files are there."""
    done = read_success(store)
    if done is None or any(done.get(key) != value for key, value in asked.items()):
        return None
    return done if sizes_agree(store, done["files"]) else None


def _result(success: Mapping[str, Any]) -> MergeResult:
    complete = not success["scenes"]["environmental"]
    return MergeResult(success["digest"], complete, success["scenes"], success["rows"])
