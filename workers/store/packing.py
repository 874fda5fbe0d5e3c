"""The layout of a range's files in the output folder: each by itself, or images in one tar for each category."""

import contextlib
import hashlib
import tarfile
from collections.abc import Mapping
from typing import IO

from schemas.dataset.commit import FileEntry, Span
from schemas.dataset.layout import is_shape, tar_path
from workers.store.store import Store
from workers.store.tars import member_header, member_of, member_order


class Packing:
    """Stores an attempt's files scene by scene: by path, or, with `tar`, images in archives and shapes by path."""

    def __init__(self, store: Store, staging: str, span: Span, tar: bool) -> None:
        self._store = store
        self._staging = staging
        self._span = span
        self._tar = tar
        self._archives: dict[str, _Archive] = {}

    def add(self, files: Mapping[str, bytes]) -> None:
        """Stores the files of one scene by path; images go into archives in their fixed order.

        Raises FileNotFoundError where the attempt's folder was swept, ValueError where a name has no place here.
        """
        images = [path for path in files if self._tar and not is_shape(path)]
        for path, data in files.items():
            if not self._tar or is_shape(path):
                self._store.write_staged(self._staging, path, data)
        for path in sorted(images, key=member_order):
            category, member = member_of(path)
            if category not in self._archives:
                name = tar_path(category, self._span.start, self._span.retry)
                self._archives[category] = _Archive(name, self._store.stream_staged(self._staging, name))
            self._archives[category].add(member, files[path])

    def finish(self, files: Mapping[str, FileEntry]) -> list[FileEntry]:
        """The files to publish for all that were added, `files` by path. Nothing can be added afterwards."""
        by_path = [entry for path, entry in files.items() if not self._tar or is_shape(path)]
        return by_path + [archive.finish() for archive in self._archives.values()]

    def close(self) -> None:
        """Closes all archives, unfinished."""
        for archive in self._archives.values():
            archive.close()


class _Dropped(Exception):
    """Ends a stream that is not to be stored."""


class _Archive:
    """A tar being written; its bytes are counted and hashed on the way."""

    def __init__(self, path: str, stream: contextlib.AbstractContextManager[IO[bytes]]) -> None:
        self._path = path
        self._open = contextlib.ExitStack()
        self._file = self._open.enter_context(stream)
        self._bytes = 0
        self._sha256 = hashlib.sha256()

    def add(self, member: str, data: bytes) -> None:
        self._write(member_header(member, len(data)) + data + bytes(-len(data) % tarfile.BLOCKSIZE))

    def finish(self) -> FileEntry:
        end = 2 * tarfile.BLOCKSIZE
        self._write(bytes(end + -(self._bytes + end) % tarfile.RECORDSIZE))
        self._open.close()
        return FileEntry(path=self._path, bytes=self._bytes, sha256=self._sha256.hexdigest())

    def close(self) -> None:
        with contextlib.suppress(_Dropped), self._open:
            raise _Dropped

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._bytes += len(data)
        self._sha256.update(data)
