"""A dataset in a folder of a file system that has hard links."""

import contextlib
import io
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO

from schemas.dataset.layout import BEGUN, COMMITS, FENCED, RANGES, STAGING, TEMPORARY, scratch_path
from schemas.errors import MachineError
from workers.store.file_system import (
    OpenTree,
    cannot_be_written,
    explain_disk_errors,
    ignore_missing,
    probe_folder,
    refuse_link_out,
    sync_folders,
    sync_path,
    temporary_file,
)
from workers.store.store import Entry, Stage, Store, retry_if_swept

RECORD = ".record"
"""The name of an attempt's record in its folder, until it is linked."""

_URL = re.compile(r"[a-z][a-z0-9+.-]+://")


class LocalStore(Store):
    """A folder; what each operation promises stands in `Store`."""

    root: Path
    layouts = ("files", "tar")
    at_once = 1

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        self.name = str(root)
        self._folder = str(self.root)

    def path(self, key: str) -> Path:
        """Where `key` lies on disk."""
        return self.root / key

    def _at(self, key: str) -> str:
        """The same as text, which takes a tenth of the time: hundreds of keys are asked for in a range."""
        return f"{self._folder}/{key}"

    def _own(self, key: str) -> str:
        """Where `key` lies on disk, to write or remove it. Raises OutputError where a link leads out of the folder."""
        refuse_link_out(self._folder, key)
        return self._at(key)

    def prepare(self) -> None:
        """Makes the folders and probes the file system."""
        try:
            for folder in (COMMITS, RANGES, TEMPORARY):
                os.makedirs(self._own(folder), exist_ok=True)
                sync_path(self.path(folder).parent)
            sync_path(self.root)
        except OSError as error:
            raise cannot_be_written(self.name, error) from error
        retry_if_swept(lambda: probe_folder(self.root))

    def put_if_absent(self, key: str, data: bytes, folder: str = TEMPORARY) -> bool:
        """Links a finished file in `folder` to `key`: the one step that refuses a second writer."""
        return not os.path.exists(self._at(key)) and self._place(os.link, key, data, folder)

    def put(self, key: str, data: bytes, durable: bool = True) -> None:
        """Renames a finished temporary file to `key`."""
        self._place(os.replace, key, data, TEMPORARY, durable)

    def move(self, source: str, target: str) -> None:
        """Moves a file; makes the target's folder where it is missing."""
        old, new = self._own(source), self._own(target)
        with self._explained(target):
            try:
                os.replace(old, new)
            except FileNotFoundError:
                os.makedirs(os.path.dirname(new), exist_ok=True)
                os.replace(old, new)

    def sync(self, keys: Iterable[str]) -> None:
        """Flushes the folders that hold `keys`, up to the output folder."""
        holders = {key.rpartition("/")[0] for key in keys}
        folders = {".", *holders, *(folder for holder in holders for folder in _folders_above(holder))} - {""}
        with self._explained("the output folder"):
            sync_folders(self.root, folders)

    def stage(self, staging: str) -> "LocalStage":
        """Makes the folder of an attempt, and keeps it open to hear of writes that fail."""
        with self._explained(staging):
            retry_if_swept(lambda: os.makedirs(self._own(staging)))
            return LocalStage(self, staging)

    def revoke(self, staging: str) -> bool:
        """Renames an attempt's folder: from then on the attempt cannot write, nor link a record."""
        with contextlib.suppress(FileNotFoundError):
            os.rename(self._own(staging), self.path(staging + FENCED))
            sync_path(self.path(staging).parent)
        # A link that found its record before the folder had another name still succeeds afterwards, while the record has a name.
        self.remove(f"{staging}{FENCED}/{RECORD}")
        return True

    def read(self, key: str) -> bytes:
        """The bytes at `key`."""
        with open(self._at(key), "rb") as file:
            return file.read()

    def open(self, key: str) -> io.BufferedIOBase:
        """The file at `key`."""
        return open(self._at(key), "rb")

    def stat(self, key: str) -> Entry | None:
        """Size and time of modification, without following what is no file to a later error."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            status = os.stat(self._at(key))
            return Entry(key, status.st_size, status.st_mtime, None)
        return None

    def files(self, prefix: str, sizes: bool = True) -> Iterator[Entry]:
        """Every file below `prefix`; one that vanishes meanwhile may be left out."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(self.path(prefix)) as entries:
            for entry in entries:
                key = f"{prefix}/{entry.name}" if prefix else entry.name
                if entry.is_dir(follow_symlinks=False):
                    yield from self.files(key, sizes)
                elif not sizes:
                    yield Entry(key, 0, 0.0, None)
                elif (stored := self.stat(key)) is not None:
                    yield stored

    def children(self, prefix: str) -> list[str]:
        """Folders directly below `prefix`."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(self.path(prefix)) as entries:
            return sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))
        return []

    def names(self, prefix: str) -> list[str]:
        """Everything directly below `prefix`."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return sorted(os.listdir(self.path(prefix)))
        return []

    def remove(self, key: str) -> None:
        """Removes a file."""
        with self._explained(key), contextlib.suppress(FileNotFoundError):
            os.unlink(self._own(key))

    def remove_tree(self, prefix: str) -> None:
        """Removes a folder; two processes may do so at once."""
        with self._explained(prefix):
            shutil.rmtree(self._own(prefix), onerror=ignore_missing)

    def remove_empty(self, prefix: str) -> None:
        """Removes an empty folder."""
        with contextlib.suppress(OSError):
            os.rmdir(self._own(prefix))

    @contextlib.contextmanager
    def scratch(self, name: str) -> Iterator[Path]:
        """A folder under `_staging/`, on the file system of its files' final names; an earlier one of the name goes."""
        prefix = scratch_path(name)
        key = f"{prefix}/{uuid.uuid4().hex}"
        # Whoever uses an earlier one loses first its name, in one step, then its contents.
        with contextlib.suppress(FileNotFoundError):
            os.rename(self._own(prefix), self.path(f"{prefix}.{uuid.uuid4().hex}"))
        for other in (f"{STAGING}/{folder}" for folder in self.children(STAGING)):
            if other.startswith(f"{prefix}."):
                self.remove_tree(other)
        try:
            with self._explained(f"a file of the {name}"):
                os.makedirs(self._own(key))
                yield self.path(key)
        except (MachineError, FileNotFoundError) as error:
            if not self.root.is_dir():
                raise MachineError(f"{self.name} was removed while a {name} worked in it") from error
            raise
        finally:
            self.remove_tree(key)
            self.remove_empty(prefix)

    def replace(self, local: Path, key: str, over: Entry | None = None) -> Entry | None:
        """Flushes a file and renames it to `key`."""
        with self._explained(key):
            sync_path(local)
            os.makedirs(os.path.dirname(self._own(key)), exist_ok=True)
            os.replace(local, self.path(key))
            sync_path(self.path(key).parent)
        return None

    def withdraw(self, key: str, folder: Path) -> bool:
        """Renames a file into a scratch folder; a folder that is empty then goes."""
        with self._explained(key):
            os.replace(self._own(key), folder / uuid.uuid4().hex)
        if "/" in key:
            self.remove_empty(key.rpartition("/")[0])
        return True

    def _place(self, name_it: Callable, key: str, data: bytes, folder: str, durable: bool = True) -> bool:
        """Writes a temporary file in `folder` and gives it the name `key` by `name_it`, os.link or os.replace.

        False where another file has the name. Raises FileNotFoundError where an attempt's folder was swept.
        """
        target = self._own(key)

        def place_once() -> bool:
            # Over NFS a list of names may be old: a sweep must know that of an attempt's record.
            name = None if folder == TEMPORARY else RECORD
            with temporary_file(self.path(folder), data, durable, name) as temporary:
                try:
                    name_it(temporary, target)
                except FileExistsError:
                    # Over NFS a link whose first answer was lost is refused although it is ours.
                    return os.path.samefile(temporary, target)
                if durable:
                    sync_path(os.path.dirname(target))
            return True

        with self._explained(key):
            os.makedirs(os.path.dirname(target), exist_ok=True)
            if folder == TEMPORARY:
                os.makedirs(self._at(TEMPORARY), exist_ok=True)
            return retry_if_swept(place_once)

    def _explained(self, key: str) -> contextlib.AbstractContextManager[None]:
        return explain_disk_errors(f"{key} in {self.name} could not be written")


class LocalStage(Stage):
    """A folder of an attempt; what each operation promises stands in `Stage`."""

    def __init__(self, store: LocalStore, staging: str) -> None:
        self._store = store
        self._staging = staging
        self._tree: OpenTree | None = None
        with contextlib.suppress(FileNotFoundError):  # swept already, as the attempt will notice
            self._tree = OpenTree(store.path(staging))
            self.write(BEGUN, b"")

    @contextlib.contextmanager
    def stream(self, path: str) -> Iterator[IO[bytes]]:
        """A file whose folders are made as needed.

        It is opened uncut: a file that is cut to nothing first is written to the disk as soon as it is closed.
        """
        key = f"{self._staging}/{path}"
        with self._store._explained(key):
            for folder in reversed(_folders_above(path)):  # never the attempt's own
                with contextlib.suppress(FileExistsError):
                    os.mkdir(self._store._at(f"{self._staging}/{folder}"))
            file = open(self._store._at(key), "wb", opener=_open_uncut)  # noqa: SIM115 - closed below, on every path
            try:
                yield file
                if self._tree is not None:
                    self._tree.flush_file(file)
            except BaseException:
                with contextlib.suppress(OSError):  # its last bytes do not fit either, and nobody wants them
                    file.close()
                raise
            file.close()

    def flush(self) -> None:
        """Flushes the folder and the names that lead to it."""
        with self._store._explained(self._staging):
            if self._tree is None:
                raise FileNotFoundError(f"{self._staging} was swept")
            try:
                self._tree.flush(self._store.root)
            finally:
                self.close()

    def put_if_absent(self, key: str, data: bytes) -> bool:
        """Links a finished file of the folder to `key`."""
        return self._store.put_if_absent(key, data, self._staging)

    def close(self) -> None:
        """Closes the folder."""
        if self._tree is not None:
            self._tree.close()
            self._tree = None


def _open_uncut(path: str, flags: int) -> int:
    """A descriptor as `open` asks for it, except that a file that is there keeps its bytes."""
    return os.open(path, flags & ~os.O_TRUNC, 0o666)


def _folders_above(path: str) -> list[str]:
    """The folders on the way to a file, the nearest first."""
    parts = path.split("/")
    return ["/".join(parts[:end]) for end in range(len(parts) - 1, 0, -1)]


def open_store(out: str) -> Store:
    """The store that a user's --out means: an object store for a URL such as s3://bucket/path, otherwise a folder.

    Reads and writes nothing yet. Raises OutputError for a URL of an unknown kind.
    """
    if _URL.match(out):
        from workers.store.objects import open_object_store  # obstore loads only where it is needed

        return open_object_store(out)
    return LocalStore(out)
