"""Deciding, then publishing: a commit record is put if absent, and any process may then rename its files into place.

The record is the only decision. It is linked from the attempt's own folder, so an attempt whose folder was swept cannot
commit any more. Publishing may be repeated by any process, at any time, any number of times.
"""

import contextlib
import hashlib
import json

from pydantic import ValidationError

from schemas.dataset.commit import CommitRecord, CommitSummary, FileEntry
from schemas.dataset.layout import COMMITS, FENCED, commit_path, is_shape, parse_commit_path, staging_path
from schemas.dataset.tables import SCHEMA_VERSION
from schemas.errors import CommitConflict, CorruptError, OutputError
from workers.store.store import Store

_SEAL = b',"seal":"'
"""The last key of a record: the SHA-256 of all bytes before it."""


def encode_record(record: CommitRecord) -> bytes:
    """Canonical JSON with a seal that reveals damage."""
    body = json.dumps(record.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), allow_nan=False)
    head = body[:-1].encode()
    return head + _SEAL + hashlib.sha256(head).hexdigest().encode() + b'"}\n'


def decode_record(data: bytes, name: str) -> CommitRecord:
    """The record in a file.

    Raises CorruptError naming it where it is torn, altered or foreign; OutputError where a newer version wrote it.
    """
    try:
        return CommitRecord.model_validate(_unsealed(data, name))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise CorruptError(f"{name} is not a commit record: {where}: {first['msg']}") from error


def commit_names(store: Store) -> list[tuple[int, int, str]]:
    """(start, retry, key) of every commit record, in the order in which they apply.

    Raises CorruptError naming a file that does not belong there.
    """
    found = []
    for key, _ in store.files(COMMITS):
        if key.rpartition("/")[2].startswith("."):
            continue
        name = parse_commit_path(key)
        if name is None:
            raise CorruptError(f"{key} in {store.name} is not a commit of this program: move it away")
        found.append((*name, key))
    return sorted(found)


def commits_digest(store: Store) -> str:
    """A digest that tells one set of commits from another: a record never changes, so keys and sizes are enough."""
    lines = [f"{key} {store.size(key)}\n" for _, _, key in commit_names(store)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def read_record(store: Store, start: int, retry: int = 0) -> CommitRecord | None:
    """The record of a range, or None where it is not committed. Raises as `decode_record`."""
    key = commit_path(start, retry)
    try:
        data = store.read(key)
    except FileNotFoundError:
        return None
    record = decode_record(data, key)
    _check_range(key, record.span.start, record.span.retry)
    return record


def read_summary(store: Store, start: int, retry: int = 0) -> CommitSummary:
    """The part of a record that planning needs, without its list of files. Raises as `decode_record`."""
    key = commit_path(start, retry)
    raw = _unsealed(store.read(key), key)
    try:
        span, scenes = raw["span"], raw["scenes"]
        _check_range(key, span["start"], span["retry"])
        failed = tuple((scene["scene_id"], scene["outcome"]) for scene in scenes if scene["outcome"] != "made")
        return CommitSummary(
            start=start,
            stop=span["stop"],
            retry=retry,
            made=len(scenes) - len(failed),
            failed=failed,
            scenes=tuple(span["scenes"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptError(f"{key} is not a commit record: {error!r}") from error


def committed_files(store: Store, record: CommitRecord) -> tuple[FileEntry, ...]:
    """Every file of a commit, sorted by path: images or tars, shapes and the range's tables."""
    return record.files


def publish(store: Store, record: CommitRecord) -> None:
    """Moves the record's files from staging to their final places, then removes the staging. Idempotent.

    Raises CorruptError naming a file that is nowhere or has the wrong size, CommitConflict where a shape that ranges
    share was published with another size by the same stack.
    """
    for entry in committed_files(store, record):
        final = store.size(entry.path) if is_shape(entry.path) else None
        if final is None:
            if not _move(store, record, entry):
                _check_final(store, entry)
        elif final != entry.bytes and record.terms.fingerprint_mode == "strict":
            raise CommitConflict(
                f"{entry.path} has {final} bytes, and {entry.bytes} in the range from scene {record.span.start}, "
                f"made by {record.terms.fingerprint}: two attempts at one shape differ"
            )
    store.sync_folders_of(entry.path for entry in committed_files(store, record))
    for folder in _staging_folders(record):
        store.remove_tree(folder)


def read_committed(store: Store, record: CommitRecord, path: str) -> bytes:
    """The bytes of one of the record's files, published or not yet. Raises CorruptError naming one that is missing."""
    staged = [f"{folder}/{path}" for folder in _staging_folders(record)]
    for key in (path, *staged, path):  # it may move from staging to its final place meanwhile
        with contextlib.suppress(FileNotFoundError):
            return store.read(key)
    raise CorruptError(f"{path} is committed and missing: restore it from a copy")


def check_published(store: Store, record: CommitRecord) -> None:
    """Raises CorruptError naming a file of the record that is not in its final place with its size.

    A shape that a mix of stacks shares keeps the size of whichever was first.
    """
    for entry in committed_files(store, record):
        _check_final(store, entry, record.terms.fingerprint_mode == "strict" or not is_shape(entry.path))


def compare_records(mine: CommitRecord, winner: CommitRecord) -> str | None:
    """How two attempts at the same scenes differ, naming both fingerprints; None where they made the same.

    Scenes that failed environmentally in either are left out: a killed scene says nothing about bytes.
    """
    theirs = {scene.scene_id: scene for scene in winner.scenes}
    different = [
        f"scene {scene.scene_id}"
        for scene in mine.scenes
        if (other := theirs.get(scene.scene_id)) is not None
        and "environmental" not in (scene.outcome, other.outcome)
        and (scene.outcome, scene.digest) != (other.outcome, other.digest)
    ]
    shapes = {entry.path: entry.sha256 for entry in winner.files if is_shape(entry.path)}
    different += [entry.path for entry in mine.files if shapes.get(entry.path, entry.sha256) != entry.sha256]
    if not different:
        return None
    return (
        f"two attempts made other bytes at {', '.join(different[:5])}{' and more' if len(different) > 5 else ''}: "
        f"{winner.attempt} (committed) on fingerprint {winner.terms.fingerprint}, "
        f"{mine.attempt} on fingerprint {mine.terms.fingerprint}"
    )


def _unsealed(data: bytes, name: str) -> dict:
    """The JSON object of a record whose seal is whole and whose version is not newer than this program's."""
    head, mark, seal = data.rpartition(_SEAL)
    try:
        raw = json.loads(data)
    except ValueError as error:
        raise CorruptError(
            f"{name} is torn or not JSON ({error}): restore it from a copy, or begin a new --out"
        ) from error
    if not isinstance(raw, dict) or raw.get("kind") != "verso-commit" or not isinstance(raw.get("schema_version"), int):
        raise CorruptError(f"{name} is not a commit record of this program: move it away")
    if raw["schema_version"] > SCHEMA_VERSION:
        raise OutputError(
            f"{name} has schema_version {raw['schema_version']}, and this program reads up to {SCHEMA_VERSION}: "
            "install a newer verso"
        )
    if not mark or seal != hashlib.sha256(head).hexdigest().encode() + b'"}\n':
        raise CorruptError(f"{name} was altered after it was written: its seal does not match")
    return raw


def _check_range(key: str, start: int, retry: int) -> None:
    if commit_path(start, retry) != key:
        raise CorruptError(f"{key} holds the record of another range: {commit_path(start, retry)}")


def _staging_folders(record: CommitRecord) -> tuple[str, str]:
    """Where the winner's files may lie before they are published: its folder, or that folder fenced."""
    staging = staging_path(record.span.start, record.attempt)
    return staging, staging + FENCED


def _move(store: Store, record: CommitRecord, entry: FileEntry) -> bool:
    """Renames one file into place; False where it is not staged (any more)."""
    for folder in _staging_folders(record):
        source = f"{folder}/{entry.path}"
        staged = store.size(source)
        if staged is None:
            continue
        if staged != entry.bytes:
            raise CorruptError(f"{source} has {staged} bytes, and its commit says {entry.bytes}")
        with contextlib.suppress(FileNotFoundError):
            store.rename(source, entry.path)
            return True
    return False


def _check_final(store: Store, entry: FileEntry, exact: bool = True) -> None:
    final = store.size(entry.path)
    if final is None:
        raise CorruptError(f"{entry.path} is named by a commit and is neither staged nor published")
    if final != entry.bytes and exact:
        raise CorruptError(f"{entry.path} has {final} bytes, and its commit says {entry.bytes}")
