"""How a range's files lie in the output folder: each by itself, or images in one tar for each category."""

import contextlib
import hashlib
import tarfile
import weakref
from collections.abc import Iterable, Iterator, Mapping
from typing import IO, Protocol

from schemas.dataset.commit import CommitRecord, FileEntry, Span
from schemas.dataset.layout import ASSETS, RANGES
from workers.store.commit import read_committed
from workers.store.store import Store
from workers.store.tars import member_header, member_of, member_order, read_tar, tar_path


class Packing(Protocol):
    """Takes an attempt's files, scene by scene."""

    def add(self, files: Mapping[str, bytes]) -> None:
        """Stores the files of one scene by path.

        Raises FileNotFoundError where the attempt's folder was swept, ValueError where a name has no place here.
        """

    def finish(self, files: Mapping[str, FileEntry]) -> Iterable[FileEntry]:
        """What is to be published for all files added, `files` by path; nothing can be added afterwards."""

    def close(self) -> None:
        """Lets go of everything, unfinished."""


class FilePacking:
    """Every file under its own name."""

    def __init__(self, store: Store, staging: str, span: Span) -> None:
        self._store = store
        self._staging = staging

    def add(self, files: Mapping[str, bytes]) -> None:
        """Writes the files to staging."""
        for path, data in files.items():
            self._store.write_staged(self._staging, path, data)

    def finish(self, files: Mapping[str, FileEntry]) -> Iterable[FileEntry]:
        """The files themselves."""
        return files.values()

    def close(self) -> None:
        """Nothing is held."""


class TarPacking:
    """Images in one archive for each category, shapes under their own names."""

    def __init__(self, store: Store, staging: str, span: Span) -> None:
        self._store = store
        self._staging = staging
        self._span = span
        self._archives: dict[str, _Archive] = {}

    def add(self, files: Mapping[str, bytes]) -> None:
        """Appends a scene's images in their fixed order, and writes its shapes."""
        for path in files:
            if _is_shape(path):
                self._store.write_staged(self._staging, path, files[path])
        for path in sorted((path for path in files if not _is_shape(path)), key=member_order):
            category, member = member_of(path)
            self._archive_of(category).add(member, files[path])

    def finish(self, files: Mapping[str, FileEntry]) -> Iterable[FileEntry]:
        """The archives, closed, and the shapes."""
        shapes = [entry for path, entry in files.items() if _is_shape(path)]
        return [*shapes, *(archive.finish() for archive in self._archives.values())]

    def close(self) -> None:
        """Closes the archives as they are."""
        for archive in self._archives.values():
            archive.close()

    def _archive_of(self, category: str) -> "_Archive":
        if category not in self._archives:
            path = tar_path(category, self._span.start, self._span.retry)
            self._archives[category] = _Archive(path, self._store.stream_staged(self._staging, path))
        return self._archives[category]


class _Archive:
    """One tar under way; what is written is hashed on the way."""

    def __init__(self, path: str, stream: contextlib.AbstractContextManager[IO[bytes]]) -> None:
        self._path = path
        self._open = contextlib.ExitStack()
        self._file = self._open.enter_context(stream)
        self._drop = weakref.finalize(self, _drop, self._open)
        self._bytes = 0
        self._sha256 = hashlib.sha256()

    def add(self, member: str, data: bytes) -> None:
        self._write(member_header(member, len(data)).tobuf(tarfile.USTAR_FORMAT))
        self._write(data + bytes(-len(data) % tarfile.BLOCKSIZE))

    def finish(self) -> FileEntry:
        self._write(bytes(2 * tarfile.BLOCKSIZE))
        self._write(bytes(-self._bytes % tarfile.RECORDSIZE))
        self._drop.detach()
        self._open.close()
        return FileEntry(path=self._path, bytes=self._bytes, sha256=self._sha256.hexdigest())

    def close(self) -> None:
        self._drop()

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._bytes += len(data)
        self._sha256.update(data)


class _Dropped(Exception):
    """Ends a stream that is not to be stored."""


def _drop(stream: contextlib.ExitStack) -> None:
    with contextlib.suppress(_Dropped), stream:
        raise _Dropped


def read_images(store: Store, record: CommitRecord) -> Iterator[tuple[str, bytes]]:
    """(path, bytes) of every image that a commit holds, whatever the layout.

    Raises CorruptError naming a file that is missing or torn; digests are for the caller to check.
    """
    for entry in record.files:
        if _is_shape(entry.path) or entry.path.startswith(f"{RANGES}/"):
            continue
        data = read_committed(store, record, entry.path)
        if record.terms.layout == "tar":
            yield from read_tar(entry.path.split("/")[0], data, entry.path)
        else:
            yield entry.path, data


def _is_shape(path: str) -> bool:
    return path.startswith(f"{ASSETS}/")
