"""Edge: the instances that a folder of files offers, with the SHA-256 of every file."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from schemas.errors import MeshError

Candidate = TypeVar("Candidate")


@dataclass(frozen=True)
class SourceFile:
    """A file as it was when the catalogue was opened: path relative to the source's folder, bytes, SHA-256."""

    path: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Entry:
    """One instance of a source of files. `files`: the mesh or URDF first, then every file that it refers to."""

    instance_id: str
    files: tuple[SourceFile, ...]
    licence: str


@dataclass(frozen=True)
class Listing:
    """What a source of files offers: entries by category in a fixed order; how many were skipped, by reason."""

    folder: Path
    entries: Mapping[str, tuple[Entry, ...]]
    skipped: Mapping[str, int] = field(default_factory=dict)


def list_entries(
    folder: Path, candidates: Mapping[str, Iterable[Candidate]], make_entry: Callable[[Candidate], Entry]
) -> Listing:
    """The entries of all candidates of each category; a candidate that raises MeshError is skipped and counted."""
    entries, skipped = {}, Counter[str]()
    for category, some in candidates.items():
        found = []
        for candidate in some:
            try:
                found.append(make_entry(candidate))
            except MeshError as error:
                skipped[error.reason] += 1
        entries[category] = tuple(found)
    return Listing(folder, entries, dict(sorted(skipped.items())))


def hash_files(paths: Iterable[Path], folder: Path) -> tuple[SourceFile, ...]:
    """The files with their sizes and digests, in the order given; reads every byte, at about 800 MB/s from cache."""
    return tuple(SourceFile(p.relative_to(folder).as_posix(), p.stat().st_size, _sha256(p)) for p in paths)


def check_unchanged(folder: Path, entry: Entry) -> None:
    """MeshError `missing` or `changed` where a file of the entry is not what it was when the catalogue was opened.

    Both are environmental: the job and its seed are not to blame, and the scene may be tried again.
    """
    for file in entry.files:
        path = folder / file.path
        try:
            digest = _sha256(path)
        except OSError as error:
            raise _environmental("missing", f"{path} cannot be read: {error.strerror}") from error
        if digest != file.sha256:
            raise _environmental("changed", f"{path} has changed since the job was started")


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _environmental(reason: str, detail: str) -> MeshError:
    error = MeshError(reason, detail)
    error.kind = "environmental"
    return error


def describe_folder(folder: Path, most: int = 5) -> str:
    """What a folder holds, for a message: its first names."""
    names = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir())
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(names[:most]) + more) if names else "nothing"
