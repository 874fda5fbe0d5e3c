"""Everything in an output folder that is no part of its dataset: files, folders, links."""

import os
import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Literal

from schemas.dataset.layout import (
    COMMITS,
    LOCK_FILE,
    LOG_FOLDER,
    MANIFEST,
    PROBE_PREFIX,
    RANGES,
    STAGING,
    commit_path,
    is_merged_path,
    is_shape,
    pose_of_image,
)
from services.read.path_index import PathIndex
from services.read.verdict import MOVE, Verdict
from workers.store.store import Store

FREE = frozenset({LOCK_FILE, LOG_FOLDER, STAGING})
"""What writers keep beside the dataset: no byte of it counts."""

FRAME = frozenset({MANIFEST, COMMITS, RANGES})
"""Folders that a run makes before it makes anything else."""

_RANGE = re.compile(rf"{RANGES}/(\d{{10,19}})(?:\.retry-(\d{{1,9}}))?/")
_TAR = re.compile(r"[^/]+/(\d{10,19})(?:\.retry-\d{1,9})?\.tar")

Kind = Literal["file", "folder", "link", "special", "unreadable"]


@dataclass(frozen=True)
class Known:
    """What belongs to the dataset, beside its commit records."""

    index: PathIndex
    merging: bool
    """Whether merged files of an earlier merge may stand: there is no `_SUCCESS`."""
    lost: tuple[tuple[int, int], ...]
    """Scenes [start, stop), in order, whose commit is missing or damaged, which is told: their files are not told again."""
    poses_per_scene: int

    def has_lost(self, key: str) -> bool:
        """Whether a file may belong to a commit that cannot be read."""
        if not self.lost:
            return False
        if is_shape(key):
            return True
        start, pose = _RANGE.match(key) or _TAR.fullmatch(key), pose_of_image(key)
        scene = int(start[1]) if start else pose // self.poses_per_scene if pose is not None else None
        if scene is None:
            return False
        at = bisect_right(self.lost, scene, key=itemgetter(0)) - 1
        return at >= 0 and scene < self.lost[at][1]


def tell_strays(store: Store, known: Known, verdict: Verdict) -> None:
    """Tells of everything that no commit names."""
    if store.root is None:
        for entry in store.files(""):
            key = entry.key
            if not FREE & {key, key.partition("/")[0]} and not _belongs(key, known):
                _tell_file(store, key, verdict)
        return
    for kind, key in _walk(store.root, ""):
        _tell_entry(store, store.root, kind, key, known, verdict)


def _tell_entry(store: Store, root: Path, kind: Kind, key: str, known: Known, verdict: Verdict) -> None:
    if kind == "link":
        verdict.tell(
            f"{key}: is a symbolic link", "put a copy of what it leads to in its place, or move it away", "stray"
        )
    elif kind == "unreadable":
        verdict.tell(f"{key}: cannot be listed", "check its permissions and the disk", "stray")
    elif kind == "special":
        verdict.tell(f"{key}: is neither a file nor a folder", MOVE, "stray")
    elif kind == "file" and not _belongs(key, known):
        _tell_file(store, key, verdict)
    elif kind == "folder" and not (known.merging or key in FRAME or key in known.index) and _is_empty(root / key):
        verdict.tell(f"{key}: is an empty folder", "remove it", "stray")


def _tell_file(store: Store, key: str, verdict: Verdict) -> None:
    """Tells of a file that no commit names, and of the commit that would name it, where that is gone."""
    found = _RANGE.match(key)
    if found and store.size(commit := commit_path(int(found[1]), int(found[2] or 0))) is None:
        told = f"{key}: is in no commit, and {commit} is missing"
        verdict.tell(told, f"restore that from a copy, or {verdict.run_again} --retry-failed", "stray")
    else:
        verdict.tell(f"{key}: is in no commit", MOVE, "stray")


def _is_empty(folder: Path) -> bool:
    try:
        with os.scandir(folder) as entries:
            return next(entries, None) is None
    except OSError:
        return False


def _belongs(key: str, known: Known) -> bool:
    """Whether a file is the dataset's, or may be."""
    name = key.rpartition("/")[2]
    if key in known.index or (known.merging and is_merged_path(key)):
        return True
    if key.startswith(f"{COMMITS}/{PROBE_PREFIX}") and "/" not in name:
        return True
    return known.has_lost(key)


def _walk(root: Path, folder: str) -> Iterator[tuple[Kind, str]]:
    """(kind, key) of everything below the output folder, in no order, without a list of it."""
    waiting = [folder]
    while waiting:
        above = waiting.pop()
        try:
            entries = os.scandir(root / above)
        except OSError:
            yield "unreadable", above
            continue
        with entries:
            for entry in entries:
                key = f"{above}/{entry.name}" if above else entry.name
                if key in FREE:
                    continue
                if entry.is_symlink():
                    yield "link", key
                elif entry.is_dir():
                    waiting.append(key)
                    yield "folder", key
                else:
                    yield "file" if entry.is_file() else "special", key
