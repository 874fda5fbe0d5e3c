"""Commit records: their sealed bytes, their listing, and the publishing of the files that they name.

A record is put if absent: it is the only decision, and it is linked from the attempt's own folder, so an attempt whose
folder was swept cannot commit any more. Any process may then move the record's files to their places, at any time, any
number of times. The seal reveals damage; it is no signature, since anyone can seal a record. So decoding refuses every path
that is not the range's own.
"""

import contextlib
import hashlib
import json
from array import array
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.dataset.commit import COMMIT_VERSION, MARK, CommitRecord, FileEntry, foreign_path
from schemas.dataset.layout import (
    COMMITS,
    FENCED,
    MAX_RETRIES,
    commit_path,
    is_shape,
    parse_commit_name,
    range_table_path,
    staging_path,
)
from schemas.errors import CommitConflict, CorruptError, OutputError, plain_line
from workers.store.manifest import listed_files
from workers.store.store import Store

ReadTable = Callable[[Store, CommitRecord, str], bytes]
"""Gives the bytes of a range's table at a path."""

_HEX = 64


def seal(text: str, before: str, after: str = "\n") -> bytes:
    """The text with a last line: the digest between `before` and `after`."""
    body = text.encode()
    return body + before.encode() + hashlib.sha256(body).hexdigest().encode() + after.encode()


def is_sealed(data: bytes, before: str, after: str = "\n") -> bool:
    """Whether a file is as it was sealed, to the byte."""
    line = len(before.encode()) + _HEX + len(after.encode())
    body = data[: max(len(data) - line, 0)]
    return data == body + before.encode() + hashlib.sha256(body).hexdigest().encode() + after.encode()


_SEAL: Final = (',"seal":"', '"}\n')
"""What stands before and after the SHA-256 of all bytes above it: the last key of a record."""


def encode_record(record: CommitRecord) -> bytes:
    """Canonical JSON with a seal.

    A file is [path, bytes, sha256], a table its number of rows; `marks` holds the digests of all scenes, and `failed`
    [scene id, kind, reason] of those that failed.
    """
    raw = record.model_dump(mode="json", exclude={"files", "scenes"})
    raw["files"] = [[entry.path, entry.bytes, entry.sha256] for entry in record.files]
    raw["marks"] = "".join(scene.digest.ljust(MARK, "-") for scene in record.scenes)
    raw["failed"] = [[mark.scene_id, mark.outcome, mark.reason] for mark in record.scenes if mark.outcome != "made"]
    return seal_record(raw)


def seal_record(raw: Mapping[str, object]) -> bytes:
    """The bytes of a record with these keys."""
    body = json.dumps(raw, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return seal(body[:-1], *_SEAL)


def decode_record(data: bytes, name: str) -> CommitRecord:
    """The record in a file.

    Raises CorruptError naming it where it is torn, altered or foreign, or names what is not its own; OutputError where a
    newer version wrote it.
    """
    raw = _unsealed(data, name)
    try:
        return CommitRecord.model_validate(_expanded(raw))
    except ValidationError as error:
        first = error.errors()[0]
        reason = ": ".join([*map(str, first["loc"]), first["msg"].removeprefix("Value error, ")])
        raise CorruptError(f"{name} is not a commit record: {plain_line(reason, 300)}") from error
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CorruptError(f"{name} is not a commit record: {error!r}"[:300]) from error


def _unsealed(data: bytes, name: str) -> dict[str, Any]:
    """The JSON object of a record whose seal is whole and whose version is not newer than this program's."""
    try:
        raw = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise CorruptError(
            f"{name} is torn or not JSON ({error}): restore it from a copy, or begin a new --out"
        ) from error
    if not isinstance(raw, dict) or raw.get("kind") != "verso-commit" or not isinstance(raw.get("schema_version"), int):
        raise CorruptError(f"{name} is not a commit record of this program: move it away")
    if raw["schema_version"] > COMMIT_VERSION:
        raise OutputError(
            f"{name} has schema_version {raw['schema_version']}, and this program reads up to {COMMIT_VERSION}: "
            "install a newer verso"
        )
    if not is_sealed(data, *_SEAL):
        raise CorruptError(f"{name} was altered after it was written: its seal does not match")
    return raw


def _expanded(raw: dict[str, Any]) -> dict[str, Any]:
    """The fields of a record from their short forms. Raises KeyError, TypeError or ValueError where they are none."""
    span, marks = raw["span"], raw["marks"]
    ids = span["scenes"] if span["retry"] else range(span["start"], span["stop"])
    if len(ids) * MARK != len(marks):  # before anything of that length is made
        raise ValueError(f"{len(marks)} characters of marks for {len(ids)} scenes")
    failed = {scene_id: {"outcome": kind, "reason": reason} for scene_id, kind, reason in raw["failed"]}
    scenes = [
        {
            "scene_id": scene_id,
            "digest": marks[at * MARK : (at + 1) * MARK],
            **failed.pop(scene_id, {"outcome": "made"}),
        }
        for at, scene_id in enumerate(ids)
    ]
    if failed:
        raise ValueError(f"scene {next(iter(failed))} failed and is not of the range")
    files = [dict(zip(("path", "bytes", "sha256"), entry, strict=True)) for entry in raw["files"]]
    return {**raw, "files": files, "scenes": scenes}


def commit_names(store: Store) -> list[tuple[int, int, str]]:
    """(start, retry, key) of every commit record, in the order in which they apply.

    Raises CorruptError naming a file that does not belong there.
    """
    return [(start, retry, commit_path(start, retry)) for start, retry in map(split_code, list_codes(store))]


def list_codes(store: Store) -> NDArray[np.int64]:
    """[N] codes of every commit record, ascending, eight bytes each. Raises as `commit_names`."""
    return np.sort(_codes_and_sizes(store, sizes=False)[0])


def code_of(start: int, retry: int) -> int:
    """A number that sorts like (start, retry)."""
    return start * MAX_RETRIES + retry


def split_code(code: int) -> tuple[int, int]:
    """(start, retry)."""
    start, retry = divmod(int(code), MAX_RETRIES)
    return start, retry


def commits_digest(store: Store) -> str:
    """A digest that tells one set of commits from another: a record never changes, so keys and sizes are enough."""
    codes, sizes = _codes_and_sizes(store, sizes=True)
    digest = hashlib.sha256()
    order = np.argsort(codes)
    for code, size in zip(codes[order].tolist(), sizes[order].tolist(), strict=True):
        digest.update(f"{commit_path(*split_code(code))} {size}\n".encode())
    return digest.hexdigest()


def _codes_and_sizes(store: Store, sizes: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    codes, bytes_ = array("q"), array("q")
    for entry in store.files(COMMITS, sizes):
        name = entry.key.removeprefix(f"{COMMITS}/")
        if name.startswith("."):
            continue
        commit = parse_commit_name(name)
        if commit is None:
            raise CorruptError(f"{COMMITS}/{name} in {store.name} is not a commit of this program: move it away")
        codes.append(code_of(*commit))
        bytes_.append(entry.bytes)
    return np.asarray(codes), np.asarray(bytes_)


def read_record(store: Store, start: int, retry: int = 0) -> CommitRecord | None:
    """The record of a range, or None where it is not committed. Raises as `decode_record`."""
    key = commit_path(start, retry)
    try:
        data = store.read(key)
    except FileNotFoundError:
        return None
    record = decode_record(data, key)
    if (its := commit_path(record.span.start, record.span.retry)) != key:
        raise CorruptError(f"{key} holds the record of another range: {its}")
    return record


def require_record(store: Store, start: int, retry: int = 0) -> CommitRecord:
    """The record of a range that is committed. Raises as `decode_record`, CorruptError where there is none."""
    record = read_record(store, start, retry)
    if record is None:
        raise CorruptError(f"{commit_path(start, retry)} vanished while {store.name} was read")
    return record


def committed_files(store: Store, record: CommitRecord, read: ReadTable | None = None) -> tuple[FileEntry, ...]:
    """Every file of a commit, sorted by path: images or tars, shapes and the range's tables.

    The record names tables and tars. The range's `views` and `assets` name the others; `read` gives their bytes in place of
    `read_range_file`. Raises CorruptError naming a table that is missing, damaged, or lists a file that is not the range's own.
    """
    files = {entry.path: entry for entry in record.files}
    for table in ("assets", "views") if record.terms.layout == "files" else ("assets",):
        path = range_table_path(record.span.start, table, record.span.retry)
        listed = listed_files(table, (read or read_range_file)(store, record, path), path)
        if (foreign := foreign_path(listed, record.span, record.terms.pairs_per_scene)) is not None:
            raise CorruptError(f"{path} lists {foreign!r}, which is not a file of its range")
        files |= {entry.path: entry for entry in listed}
    return tuple(files[path] for path in sorted(files))


def publish(store: Store, record: CommitRecord, written: Iterable[FileEntry] | None = None) -> None:
    """Moves the record's files from staging to their final places, then removes the staging. Idempotent.

    `written`: all of the record's files, from who wrote them just now; others read them from its tables. Raises CorruptError
    naming a file that is nowhere or has the wrong size, CommitConflict where a shape that ranges share was published with
    another size by the same stack.
    """
    files = committed_files(store, record) if written is None else tuple(written)
    folders = _staging_folders(record)
    for entry in files:
        final = store.size(entry.path) if is_shape(entry.path) else None
        if final is None:
            _put_in_place(store, folders, entry)
        elif final != entry.bytes and record.terms.fingerprint_mode == "strict":
            raise CommitConflict(
                f"{entry.path} has {final} bytes, and {entry.bytes} in the range from scene {record.span.start}, "
                f"made by {record.terms.fingerprint}: two attempts at one shape differ"
            )
    store.sync(entry.path for entry in files)
    for folder in folders:
        store.remove_tree(folder)


def read_range_file(store: Store, record: CommitRecord, path: str) -> bytes:
    """The bytes of a file that the record itself names. Raises CorruptError where it is missing or altered."""
    entry = next((file for file in record.files if file.path == path), None)
    if entry is None:
        raise CorruptError(f"the commit of the range from scene {record.span.start} names no {path}")
    data = read_committed(store, record, path)
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise CorruptError(f"{path} does not match the SHA-256 in its commit: restore it from a copy")
    return data


def read_committed(store: Store, record: CommitRecord, path: str) -> bytes:
    """The bytes of one of the record's files, published or not yet. Raises CorruptError naming one that is missing."""
    staged = [f"{folder}/{path}" for folder in _staging_folders(record)]
    for key in (path, *staged, path):  # it may move from staging to its final place meanwhile
        with contextlib.suppress(FileNotFoundError):
            return store.read(key)
    raise CorruptError(f"{path} is committed and missing: restore it from a copy")


def compare_attempts(
    mine: CommitRecord, my_files: Iterable[FileEntry], winner: CommitRecord, its_files: Iterable[FileEntry]
) -> str | None:
    """How two attempts at the same scenes differ, naming both fingerprints; None where they made the same.

    Of the files, shapes are compared; a scene's digest covers its images. Scenes that failed
    environmentally in either are left out: a killed scene says nothing about bytes.
    """
    theirs = {mark.scene_id: mark for mark in winner.scenes}
    pairs = [(mark, theirs[mark.scene_id]) for mark in mine.scenes if mark.scene_id in theirs]
    different = [
        f"scene {mark.scene_id}"
        for mark, other in pairs
        if mark != other and "environmental" not in (mark.outcome, other.outcome)
    ]
    shapes = {entry.path: entry.sha256 for entry in its_files if is_shape(entry.path)}
    different += [entry.path for entry in my_files if shapes.get(entry.path, entry.sha256) != entry.sha256]
    if not different:
        return None
    stacks = [f"{made.attempt} on fingerprint {made.terms.fingerprint}" for made in (winner, mine)]
    return (
        f"two attempts made other bytes at {', '.join(different[:5])}{' and more' if len(different) > 5 else ''}: "
        f"{stacks[0]} (committed), {stacks[1]}"
    )


def _staging_folders(record: CommitRecord) -> tuple[str, str]:
    """Where the winner's files may lie before they are published: its folder, or that folder fenced."""
    staging = staging_path(record.span.start, record.attempt)
    return staging, staging + FENCED


def _put_in_place(store: Store, folders: Iterable[str], entry: FileEntry) -> None:
    """Moves one file into place from one of the folders, unless it is there."""
    for folder in folders:
        source = f"{folder}/{entry.path}"
        staged = store.size(source)
        if staged is None:
            continue
        if staged != entry.bytes:
            raise CorruptError(f"{source} has {staged} bytes, and its commit says {entry.bytes}")
        with contextlib.suppress(FileNotFoundError):
            store.move(source, entry.path)
            return
    final = store.size(entry.path)
    if final is None:
        raise CorruptError(f"{entry.path} is named by a commit and is neither staged nor published")
    if final != entry.bytes:
        raise CorruptError(f"{entry.path} has {final} bytes, and its commit says {entry.bytes}")
