"""A whole folder against its commits: merged files, `_SUCCESS`, DATASET.md, and everything that is no part of the dataset."""

import json
import os
import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import zip_longest
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.layout import (
    COMMITS,
    LOCK_FILE,
    LOG_FOLDER,
    MANIFEST,
    PROBE_PREFIX,
    RANGES,
    README_FILE,
    STAGING,
    SUCCESS_FILE,
    commit_path,
    is_merged_path,
    is_shape,
    pose_of_image,
)
from services.merge.merge import encode_success, file_entry
from services.merge.reading import PathTable
from services.merge.tables import is_card_sealed
from services.read.verdict import MOVE, Verdict, describe_os_error, printable, read_or_tell
from workers.store.file_system import sha256_of
from workers.store.store import Store

FREE = frozenset({LOCK_FILE, LOG_FOLDER, STAGING})
"""What writers keep beside the dataset: no byte of it counts."""

FRAME = frozenset({MANIFEST, COMMITS, RANGES})
"""Folders that a run makes before it makes anything else."""

_RANGE = re.compile(rf"{RANGES}/(\d{{10,19}})(?:\.retry-(\d{{1,9}}))?/")
_TAR = re.compile(r"[^/]+/(\d{10,19})(?:\.retry-\d{1,9})?\.tar")

Kind = Literal["file", "empty folder", "link", "special", "unreadable"]


@dataclass(frozen=True)
class Known:
    """What belongs to the dataset, beside its commit records."""

    index: PathTable
    merging: bool
    """Whether merged files of an earlier merge may stand: there is no `_SUCCESS`."""
    lost: tuple[tuple[int, int], ...]
    """Scenes [start, stop), in order, whose commit is missing or damaged, which is told: their files are not told again."""
    poses_per_scene: int

    def has(self, key: str) -> bool:
        """Whether a file is the dataset's, or may be, because it may belong to a commit that cannot be read."""
        if (
            self.index.get(key) is not None
            or (self.merging and is_merged_path(key))
            or key.startswith(f"{COMMITS}/{PROBE_PREFIX}")
        ):
            return True
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


ODD: dict[Kind, tuple[str, str]] = {
    "file": ("is in no commit", MOVE),
    "link": ("is a symbolic link", "put a copy of what it leads to in its place, or move it away"),
    "unreadable": ("cannot be listed", "check its permissions and the disk"),
    "special": ("is neither a file nor a folder", MOVE),
    "empty folder": ("is an empty folder", "remove it"),
}
"""What is told of what is no part of a dataset, and what to do about it."""


def tell_strays(store: Store, known: Known, verdict: Verdict) -> None:
    """Tells of everything that no commit names."""
    for kind, key in _walk(store):
        what, remedy = ODD[kind]
        if kind == "file":
            if known.has(key):
                continue
            range_of = _RANGE.match(key)
            if range_of and store.size(commit := commit_path(int(range_of[1]), int(range_of[2] or 0))) is None:
                what += f", and {commit} is missing"
                remedy = f"restore that from a copy, or {verdict.run_again} --retry-failed"
        elif kind == "empty folder" and (known.merging or key in FRAME or known.index.get(key) is not None):
            continue
        verdict.tell(f"{key}: {what}", remedy, "stray")


def _walk(store: Store) -> Iterator[tuple[Kind, str]]:
    """(kind, key) of everything that writers do not keep for themselves, in no order, without a list of it."""
    if store.root is None:
        keys = (entry.key for entry in store.files(""))
        yield from (("file", key) for key in keys if not FREE & {key, key.partition("/")[0]})
        return
    waiting = [""]
    while waiting:
        above = waiting.pop()
        try:
            entries = os.scandir(store.root / above)
        except OSError:
            yield "unreadable", above
            continue
        empty = True
        with entries:
            for entry in entries:
                empty = False
                key = f"{above}/{entry.name}" if above else entry.name
                if key in FREE:
                    continue
                if entry.is_symlink():
                    yield "link", key
                elif entry.is_dir():
                    waiting.append(key)
                else:
                    yield "file" if entry.is_file() else "special", key
        if empty:
            yield "empty folder", above


_ROWS = 4_096
"""Rows of a merged table that are compared at once."""


@dataclass(frozen=True)
class Success:
    """`_SUCCESS` as it was found."""

    data: bytes | None
    """None where there is no file that can be read."""
    tree: dict[str, Any]
    """Its keys; none where it is damaged."""

    @property
    def files(self) -> dict[str, dict[str, Any]]:
        """{bytes, sha256} of each merged file that it names, as far as it is well formed."""
        files = self.tree.get("files")
        return {key: one for key, one in files.items() if isinstance(one, dict)} if isinstance(files, dict) else {}

    @property
    def asked(self) -> tuple[int, int] | None:
        """First scene and stop."""
        ends = [self.tree.get(key) for key in ("first_scene", "stop_scene")]
        return (ends[0], ends[1]) if all(type(end) is int and end >= 0 for end in ends) else None  # type: ignore[return-value]


def read_stored_success(store: Store, verdict: Verdict) -> Success:
    """`_SUCCESS`, and whether it is an object of JSON at all."""
    try:
        data = store.read(SUCCESS_FILE)
    except FileNotFoundError:
        return Success(None, {})
    except OSError as error:
        verdict.tell(f"{SUCCESS_FILE}: {describe_os_error(error)}", verdict.merge_again, "merge")
        return Success(b"", {})
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        tree = None
    if isinstance(tree, dict):
        return Success(data, tree)
    verdict.tell(f"{SUCCESS_FILE}: is {'damaged' if data else 'empty'}", verdict.merge_again, "merge")
    return Success(data, {})


def check_success(success: Success, expected: Mapping[str, Any], verdict: Verdict) -> None:
    """Compares `_SUCCESS`, to the byte, with what merging the commits again gives."""
    if success.data is None or not success.tree or success.data == encode_success(expected):
        return
    wrong = sorted(key for key in {*success.tree, *expected} if success.tree.get(key) != expected.get(key))
    what = f"its {', '.join(map(printable, wrong))} {'is' if len(wrong) == 1 else 'are'} not what the commits give"
    verdict.tell(
        f"{SUCCESS_FILE}: {what if wrong else 'was altered after the merge wrote it'}", verdict.merge_again, "merge"
    )


def check_merged(
    store: Store, success: Success, remade: Mapping[str, Path], verdict: Verdict
) -> dict[str, dict[str, object]]:
    """Compares every merged file with the one that the commits give; {bytes, sha256} that `_SUCCESS` must hold for each.

    Parquet bytes change with pyarrow's version: where `_SUCCESS` vouches for other bytes, their rows must be the same.
    Where the commits cannot be merged again, nothing is `remade`, and files are compared with `_SUCCESS` alone.
    """
    entries = {path: file_entry(local) for path, local in sorted(remade.items())} or dict(success.files)
    for path, entry in entries.items():
        stored = _hash_file(store, path, verdict)
        vouched = stored == success.files.get(path)
        if isinstance(stored, str):
            verdict.tell(f"{path}: {stored}", verdict.merge_again, "merge")
        elif stored != entry and not vouched:
            verdict.tell(f"{path}: does not match the SHA-256 in {SUCCESS_FILE}", verdict.merge_again, "merge")
        elif stored != entry and path.endswith(".parquet") and _same_rows(store, path, remade[path]):
            entries[path] = stored
        elif stored != entry:
            verdict.tell(f"{path}: does not hold the rows of the commits", verdict.merge_again, "merge")
    return entries


def check_card(store: Store, digest: str, verdict: Verdict) -> None:
    """DATASET.md: as it was written, and of this dataset."""
    if (data := read_or_tell(store, README_FILE, verdict, verdict.merge_again, "card")) is None:
        return
    if not is_card_sealed(data):
        verdict.tell(
            f"{README_FILE}: was altered after a run wrote it: its seal does not match", verdict.merge_again, "card"
        )
    elif f"| dataset digest | `{digest}` |".encode() not in data:
        verdict.tell(f"{README_FILE}: does not name the dataset digest {digest[:12]}", verdict.merge_again, "card")


def _hash_file(store: Store, path: str, verdict: Verdict) -> dict[str, object] | str:
    """{bytes, sha256} of a stored file, or why it cannot be read; on a disk in constant memory."""
    try:
        with store.open(path) as file:
            digest, size = sha256_of(file), file.seek(0, os.SEEK_END)
    except FileNotFoundError:
        return "is merged and missing"
    except OSError as error:
        return describe_os_error(error)
    verdict.files += 1
    verdict.bytes += size
    return {"bytes": size, "sha256": digest}


def _holds(stored: pa.RecordBatch, remade: pa.RecordBatch) -> bool:
    """Whether rows are the same. Before a version added a column, or let values be missing, there was none, and none missing."""
    lacking = set(remade.schema.names) - set(stored.schema.names)

    def is_same(name: str, values: pa.Array) -> bool:
        if name in lacking:
            return bool(values.null_count == len(values))
        there = stored.column(name)
        return bool(values.equals(there if there.type == values.type else there.cast(values.type)))

    names = remade.schema.names
    return set(names) >= set(stored.schema.names) and all(map(is_same, names, remade.columns))


def _same_rows(store: Store, path: str, local: Path) -> bool:
    try:
        with store.open(path) as file, pq.ParquetFile(local) as remade:
            stored = pq.ParquetFile(file, page_checksum_verification=True)
            pairs = zip_longest(stored.iter_batches(_ROWS), remade.iter_batches(_ROWS))
            return all(a is not None and b is not None and _holds(a, b) for a, b in pairs)
    except (pa.ArrowException, OSError, ValueError):
        return False
