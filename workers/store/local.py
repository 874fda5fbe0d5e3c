"""A dataset on a file system that has hard links."""

import contextlib
import errno
import os
import shutil
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

from schemas.dataset.layout import COMMITS, RANGES, STAGING
from schemas.errors import OutputError
from workers.store.disk_errors import told_plainly
from workers.store.durable import sync_file, sync_folder, sync_folders, sync_tree
from workers.store.probe import probe_folder
from workers.store.store import TEMPORARY, Entry, fenced_key

_VANISHED_TRIES = 3
"""A temporary file may be swept by another coordinator between two of our steps; it is then written again."""


class LocalStore:
    """A folder on a file system that has hard links."""

    tar_only = False

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        self.name = str(root)
        self._prefix = os.path.join(self.root, "")

    def path(self, key: str) -> Path:
        """Where `key` lies on disk."""
        return self.root / key

    def _at(self, key: str) -> str:
        """As `path`, without the cost of a Path: a scene has two dozen files."""
        return self._prefix + key

    def prepare(self) -> None:
        """Makes the folder and proves the primitive (see `Store`)."""
        try:
            for folder in (COMMITS, RANGES, TEMPORARY):
                os.makedirs(self.path(folder), exist_ok=True)
                sync_folder(self.path(folder).parent)
            sync_folder(self.root)
        except OSError as error:
            raise OutputError(
                f"{self.name} cannot be written: {error.strerror or error}; choose another --out"
            ) from error
        probe_folder(self.root)

    def open_staging(self, staging: str) -> None:
        """Makes the folder of an attempt."""
        for last in range(_VANISHED_TRIES):
            with self._told(staging), _unless(FileNotFoundError, last < _VANISHED_TRIES - 1):
                os.makedirs(self.path(staging))
                return

    def write_staged(self, staging: str, path: str, data: bytes) -> None:
        """Writes a file of an attempt (see `Store`)."""
        with self.stream_staged(staging, path) as file:
            file.write(data)

    @contextlib.contextmanager
    def stream_staged(self, staging: str, path: str) -> Iterator[IO[bytes]]:
        """A writable file of an attempt (see `Store`)."""
        key = f"{staging}/{path}"
        target = self._at(key)
        with self._told(key):
            try:
                file = open(target, "wb")  # noqa: SIM115 - closed below, on every path
            except FileNotFoundError:
                _make_folders(self.path(staging), Path(path).parent)
                file = open(target, "wb")  # noqa: SIM115
            with file:
                yield file

    def make_durable(self, staging: str) -> None:
        """Flushes an attempt (see `Store`)."""
        with self._told(staging):
            sync_tree(self.path(staging))

    def put_if_absent(self, key: str, data: bytes, staging: str | None = None) -> bool:
        """Links a finished temporary file to `key`: the one step that refuses a second writer (see `Store`)."""
        target = self.path(key)
        if target.exists():
            return False
        for last in range(_VANISHED_TRIES):
            with self._told(key), self._temporary(data, staging) as temporary:
                try:
                    os.link(temporary, target)
                except FileExistsError:
                    # Over NFS a link whose first answer was lost is refused although it is ours.
                    return os.path.samefile(temporary, target)
                except FileNotFoundError:
                    swept = not temporary.exists()
                    if (swept and staging is not None) or last == _VANISHED_TRIES - 1:
                        raise
                    os.makedirs(target.parent, exist_ok=True)
                    continue
                sync_folder(target.parent)
                return True
        raise AssertionError("unreachable")

    def write_whole(self, key: str, data: bytes, durable: bool = True) -> None:
        """Renames a finished temporary file to `key` (see `Store`)."""
        for last in range(_VANISHED_TRIES):
            with self._told(key), self._temporary(data, None, durable) as temporary:
                try:
                    os.replace(temporary, self.path(key))
                except FileNotFoundError:
                    if last == _VANISHED_TRIES - 1:
                        raise
                    os.makedirs(self.path(key).parent, exist_ok=True)
                    continue
                if durable:
                    sync_folder(self.path(key).parent)
                return

    def rename(self, source: str, target: str) -> None:
        """Moves a file (see `Store`)."""
        with self._told(target):
            try:
                os.replace(self._at(source), self._at(target))
            except FileNotFoundError:
                os.makedirs(self.path(target).parent, exist_ok=True)
                os.replace(self._at(source), self._at(target))

    def sync_folders_of(self, keys: Iterable[str]) -> None:
        """Flushes the folders that hold `keys`, up to the output folder."""
        folders = {key.rpartition("/")[0] for key in keys}
        with self._told("the output folder"):
            sync_folders(self.root, {parent for folder in folders for parent in (folder, *_parents(folder))})

    def fence(self, staging: str) -> str | None:
        """Renames an attempt's folder: from then on it cannot write, nor link a record (see `Store`)."""
        fenced = fenced_key(staging)
        try:
            os.rename(self.path(staging), self.path(fenced))
        except FileNotFoundError:
            return fenced if self.path(fenced).is_dir() else None
        sync_folder(self.path(fenced).parent)
        return fenced

    def read(self, key: str) -> bytes:
        """The bytes at `key` (see `Store`)."""
        return self.path(key).read_bytes()

    def size(self, key: str) -> int | None:
        """Bytes at `key`, or None."""
        try:
            return os.stat(self._at(key)).st_size
        except (FileNotFoundError, NotADirectoryError):
            return None

    def modified(self, key: str) -> float | None:
        """Modification time at `key`, or None."""
        try:
            return os.stat(self._at(key)).st_mtime
        except (FileNotFoundError, NotADirectoryError):
            return None

    def files(self, prefix: str) -> Iterator[Entry]:
        """Every file below `prefix` (see `Store`); one that vanishes meanwhile is left out."""
        try:
            found = sorted(os.scandir(self.path(prefix)), key=lambda entry: entry.name)
        except (FileNotFoundError, NotADirectoryError):
            return
        for entry in found:
            key = f"{prefix}/{entry.name}"
            if entry.is_dir(follow_symlinks=False):
                yield from self.files(key)
            elif (size := self.size(key)) is not None:
                yield Entry(key, size)

    def children(self, prefix: str) -> list[str]:
        """Folders directly below `prefix`."""
        try:
            return sorted(entry.name for entry in os.scandir(self.path(prefix)) if entry.is_dir(follow_symlinks=False))
        except (FileNotFoundError, NotADirectoryError):
            return []

    def remove(self, key: str) -> None:
        """Removes a file."""
        with self._told(key), contextlib.suppress(FileNotFoundError):
            os.unlink(self.path(key))

    def remove_tree(self, prefix: str) -> None:
        """Removes a folder; two processes may do so at once."""
        with self._told(prefix):
            shutil.rmtree(self.path(prefix), onerror=_ignore_missing)

    def remove_empty(self, prefix: str) -> None:
        """Removes an empty folder."""
        with contextlib.suppress(OSError):
            os.rmdir(self.path(prefix))

    @contextlib.contextmanager
    def scratch(self, name: str) -> Iterator[Path]:
        """A folder under `_staging/`, on the same file system as its files' final names."""
        key = f"{STAGING}/_{name}/{uuid.uuid4().hex}"
        with self._told(key):
            os.makedirs(self.path(key))
        try:
            yield self.path(key)
        finally:
            self.remove_tree(key)

    def install(self, local: Path, key: str) -> None:
        """Flushes a file and renames it to `key`."""
        with self._told(key):
            sync_file(local)
            os.makedirs(self.path(key).parent, exist_ok=True)
            os.replace(local, self.path(key))
            sync_folder(self.path(key).parent)

    @contextlib.contextmanager
    def _temporary(self, data: bytes, staging: str | None, durable: bool = True) -> Iterator[Path]:
        """A finished file beside its final place's file system, gone when the context ends."""
        folder = self.path(staging or TEMPORARY)
        if staging is None:
            os.makedirs(folder, exist_ok=True)
        temporary = folder / f".{uuid.uuid4().hex}"
        try:
            with open(temporary, "xb") as file:
                file.write(data)
                file.flush()
                if durable:
                    os.fsync(file.fileno())
            yield temporary
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)

    def _told(self, key: str) -> contextlib.AbstractContextManager[None]:
        return told_plainly(f"{key} in {self.name} could not be written")


def _unless(error: type[BaseException], suppressed: bool) -> contextlib.AbstractContextManager[None]:
    return contextlib.suppress(error) if suppressed else contextlib.nullcontext()


def _parents(folder: str) -> list[str]:
    """Every folder above `folder`, relative like it, down to the empty name."""
    found = []
    while folder:
        folder = folder.rpartition("/")[0]
        found.append(folder)
    return found


def _make_folders(root: Path, below: Path) -> None:
    """Makes the folders `below` in `root`, but never `root` itself. Raises FileNotFoundError where that is gone."""
    if not below.parts:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(root))
    folder = root
    for part in below.parts:
        folder = folder / part
        with contextlib.suppress(FileExistsError):
            os.mkdir(folder)


def _ignore_missing(function: object, path: str, raised: tuple[type[BaseException], BaseException, object]) -> None:
    if not isinstance(raised[1], FileNotFoundError):
        raise raised[1]
