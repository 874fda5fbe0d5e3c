"""The bytes of a commit record: canonical JSON in one line, with a seal that reveals damage.

The seal is no signature: anyone can seal a record. So decoding refuses every path that is not the range's own.
"""

import json
from collections.abc import Mapping
from typing import Any, Final

from pydantic import ValidationError

from schemas.dataset.commit import COMMIT_VERSION, MARK, CommitRecord
from schemas.errors import CorruptError, OutputError
from schemas.plain_line import plain_line
from workers.store.seal import is_sealed, seal

_SEAL: Final = (',"seal":"', '"}\n')
"""What stands before and after the SHA-256 of all bytes above it: the last key of a record."""


def encode_record(record: CommitRecord) -> bytes:
    """Canonical JSON with a seal.

    A file is [path, bytes, sha256], a table its number of rows; `marks` holds the digests of all scenes, and `failed`
    [scene id, kind, reason] of those that failed.
    """
    raw = record.model_dump(mode="json", exclude={"files", "tables", "scenes"})
    raw["files"] = [[entry.path, entry.bytes, entry.sha256] for entry in record.files]
    raw["tables"] = {table: entry.rows for table, entry in record.tables.items()}
    raw["marks"] = "".join(scene.digest[:MARK].ljust(MARK, "-") for scene in record.scenes)
    raw["failed"] = [[one.scene_id, one.outcome, one.reason] for one in record.scenes if one.outcome != "made"]
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
        return CommitRecord.model_validate(_expanded(raw) if "marks" in raw else raw)
    except ValidationError as error:
        first = error.errors()[0]
        where = plain_line("".join(f"{part}: " for part in (".".join(map(str, first["loc"])),) if part), 100)
        told = plain_line(first["msg"].removeprefix("Value error, "), 300)
        raise CorruptError(f"{name} is not a commit record: {where}{told}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
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
    tables = {table: {"rows": rows} for table, rows in raw["tables"].items()}
    return {**raw, "files": files, "tables": tables, "scenes": scenes}
