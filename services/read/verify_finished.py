"""A finished dataset against its commits: they are merged again, and `_SUCCESS`, the merged files and DATASET.md compared."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.layout import README_FILE, SUCCESS_FILE
from services.merge.dataset_card import is_card_sealed
from services.merge.merge import encode_success
from services.read.verdict import Verdict, describe_os_error, printable
from workers.store.store import Store

_ROWS = 4_096
"""Rows of a merged table that are compared at once."""


@dataclass(frozen=True)
class Success:
    """`_SUCCESS` as it was found."""

    data: bytes | None
    """None where there is no file that can be read."""
    told: dict[str, Any]
    """Its keys; none where it is damaged."""

    @property
    def files(self) -> dict[str, dict[str, Any]]:
        """{bytes, sha256} of each merged file that it names, as far as it is well formed."""
        files = self.told.get("files")
        return {key: one for key, one in files.items() if isinstance(one, dict)} if isinstance(files, dict) else {}

    @property
    def asked(self) -> tuple[int, int] | None:
        """First scene and stop."""
        ends = [self.told.get(key) for key in ("first_scene", "stop_scene")]
        return (ends[0], ends[1]) if all(type(end) is int and end >= 0 for end in ends) else None  # type: ignore[return-value]


def read_stored_success(store: Store, verdict: Verdict) -> Success:
    """`_SUCCESS`, and whether it is an object of JSON at all."""
    try:
        data = store.read(SUCCESS_FILE)
    except FileNotFoundError:
        return Success(None, {})
    except OSError as error:
        verdict.tell(f"{SUCCESS_FILE}: {describe_os_error(error)}", verdict.repair, "merge")
        return Success(b"", {})
    try:
        told = json.loads(data)
    except (ValueError, RecursionError):
        told = None
    if isinstance(told, dict):
        return Success(data, told)
    verdict.tell(f"{SUCCESS_FILE}: is {'damaged' if data else 'empty'}", verdict.repair, "merge")
    return Success(data, {})


def check_success(success: Success, expected: Mapping[str, Any], verdict: Verdict) -> None:
    """Compares `_SUCCESS`, to the byte, with what merging the commits again gives."""
    if success.data is None or not success.told or success.data == encode_success(expected):
        return
    wrong = sorted(key for key in {*success.told, *expected} if success.told.get(key) != expected.get(key))
    told = f"its {', '.join(map(printable, wrong))} {'is' if len(wrong) == 1 else 'are'} not what the commits give"
    verdict.tell(
        f"{SUCCESS_FILE}: {told if wrong else 'was altered after the merge wrote it'}", verdict.repair, "merge"
    )


def check_merged(
    store: Store, success: Success, remade: Mapping[str, Path], verdict: Verdict
) -> dict[str, dict[str, object]]:
    """Compares every merged file with the one that the commits give; {bytes, sha256} that `_SUCCESS` must hold for each.

    Parquet bytes change with pyarrow's version: where `_SUCCESS` vouches for other bytes, their rows must be the same.
    """
    entries: dict[str, dict[str, object]] = {}
    for path, local in sorted(remade.items()):
        with open(local, "rb") as file:
            entry = {"bytes": local.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}
        entries[path] = entry
        found = _hash_file(store, path, verdict)
        if isinstance(found, str):
            verdict.tell(f"{path}: {found}", verdict.repair, "merge")
        elif found != entry:
            if found == success.files.get(path) and path.endswith(".parquet") and _same_rows(store, path, local):
                entries[path] = found
            elif found == success.files.get(path):
                verdict.tell(f"{path}: does not hold the rows of the commits", verdict.repair, "merge")
            else:
                verdict.tell(f"{path}: does not match the SHA-256 in {SUCCESS_FILE}", verdict.repair, "merge")
    return entries


def check_told(store: Store, success: Success, verdict: Verdict) -> None:
    """Compares merged files with `_SUCCESS` alone, where the commits cannot be merged again."""
    for path, entry in success.files.items():
        found = _hash_file(store, path, verdict)
        if isinstance(found, str):
            verdict.tell(f"{path}: {found}", verdict.repair, "merge")
        elif found != entry:
            verdict.tell(f"{path}: does not match the SHA-256 in {SUCCESS_FILE}", verdict.repair, "merge")


def check_card(store: Store, digest: str, sealed: bool, verdict: Verdict) -> None:
    """DATASET.md: as it was written, and of this dataset. `sealed` says that job.yaml has a seal, so this has one too."""
    try:
        data = store.read(README_FILE)
    except OSError as error:
        verdict.tell(f"{README_FILE}: {describe_os_error(error)}", verdict.repair, "card")
        return
    if sealed and not is_card_sealed(data):
        verdict.tell(
            f"{README_FILE}: was altered after a run wrote it: its seal does not match", verdict.repair, "card"
        )
    elif f"| dataset digest | `{digest}` |".encode() not in data:
        verdict.tell(f"{README_FILE}: does not name the dataset digest {digest[:12]}", verdict.repair, "card")


def _hash_file(store: Store, path: str, verdict: Verdict) -> dict[str, object] | str:
    """{bytes, sha256} of a stored file, or why it cannot be read; on a disk in constant memory."""
    try:
        if store.root is None:
            data = store.read(path)
            size, digest = len(data), hashlib.sha256(data).hexdigest()
        else:
            with open(store.root / path, "rb") as file:
                digest, size = hashlib.file_digest(file, "sha256").hexdigest(), file.tell()
    except FileNotFoundError:
        return "is merged and missing"
    except OSError as error:
        return describe_os_error(error)
    verdict.files += 1
    verdict.bytes += size
    return {"bytes": size, "sha256": digest}


def _same_rows(store: Store, path: str, local: Path) -> bool:
    try:
        source = pa.BufferReader(store.read(path)) if store.root is None else store.root / path
        with pq.ParquetFile(source, page_checksum_verification=True) as stored, pq.ParquetFile(local) as remade:
            pairs = zip_longest(stored.iter_batches(_ROWS), remade.iter_batches(_ROWS))
            return all(a is not None and b is not None and a.equals(b) for a, b in pairs)
    except (pa.ArrowException, OSError, ValueError):
        return False
