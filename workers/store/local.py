"""A dataset in a folder of a file system that has hard links."""

import contextlib
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO

from schemas.dataset.layout import COMMITS, FENCED, RANGES, STAGING, TEMPORARY, scratch_path
from schemas.errors import OutputError
from workers.store.file_system import (
    Opener,
    OpenTree,
    explain_disk_errors,
    ignore_missing,
    open_uncut,
    probe_folder,
    refuse_link_out,
    remedy_of,
    sync_folders,
    sync_path,
    sync_tree,
    temporary_file,
)
from workers.store.store import Entry, Store, Version, retry_if_swept

_URL = re.compile(r"[a-z][a-z0-9+.-]+://")


def open_store(out: str) -> Store:
    """The store that a user's --out means: an object store for a URL such as s3://bucket/path, otherwise a folder.

    Reads and writes nothing yet. Raises OutputError for a URL of an unknown kind.
    """
    if not _URL.match(out):
        return LocalStore(out)
    from workers.store.objects import open_object_store  # obstore loads only where it is needed

    return open_object_store(out)


class LocalStore(Store):
    """A folder; what each operation promises stands in `Store`."""

    root: Path
    tar_only = False
    fence_is_final = True

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        self.name = str(root)
        self._folder = str(self.root)
        self._open: dict[str, OpenTree] = {}
        """By the folders of this object's attempts, each until it is durable or removed."""

    def path(self, key: str) -> Path:
        """Where `key` lies on disk."""
        return self.root / key

    def _at(self, key: str) -> str:
        """The same as text, which takes a tenth of the time: hundreds of keys are asked for in a range."""
        return f"{self._folder}/{key}"

    def _own(self, key: str, plain: set[str] | None = None) -> str:
        """Where `key` lies on disk, to write or remove it. Raises OutputError where a link leads out of the folder."""
        refuse_link_out(self._folder, key, plain)
        return self._at(key)

    def prepare(self) -> None:
        """Makes the folders and probes the file system."""
        try:
            for folder in (COMMITS, RANGES, TEMPORARY):
                os.makedirs(self._own(folder), exist_ok=True)
                sync_path(self.path(folder).parent)
            sync_path(self.root)
        except OSError as error:
            why = remedy_of(error) or error.strerror or error
            raise OutputError(f"{self.name} cannot be written: {why}; or choose another --out") from error
        probe_folder(self.root)

    def open_staging(self, staging: str) -> None:
        """Makes the folder of an attempt, and keeps it open to hear of writes that fail."""
        with self._explained(staging):
            retry_if_swept(lambda: os.makedirs(self._own(staging)))
            with contextlib.suppress(FileNotFoundError):  # swept already, as the attempt will notice
                self._open[staging] = OpenTree(self.path(staging))

    @contextlib.contextmanager
    def stream_staged(self, staging: str, path: str, opener: Opener | None = None) -> Iterator[IO[bytes]]:
        """A file below the attempt's folder, whose subfolders are made as needed; `opener`: as of `open`."""
        target = self._at(f"{staging}/{path}")
        with self._explained(f"{staging}/{path}"):
            try:
                file = open(target, "wb", opener=opener)  # noqa: SIM115 - closed below, on every path
            except FileNotFoundError:
                for folder in reversed(_folders_above(path)):  # never the attempt's own
                    with contextlib.suppress(FileExistsError):
                        os.mkdir(self._at(f"{staging}/{folder}"))
                file = open(target, "wb", opener=opener)  # noqa: SIM115
            try:
                yield file
                if tree := self._open.get(staging):
                    tree.flush_file(file)
            except BaseException:
                with contextlib.suppress(OSError):  # its last bytes do not fit either, and nobody wants them
                    file.close()
                raise
            file.close()

    def write_note(self, staging: str, path: str, data: bytes) -> None:
        """In place: a file that is cut to nothing first is written to the disk as soon as it is closed."""
        with self.stream_staged(staging, path, open_uncut) as file:
            file.write(data)

    def make_durable(self, staging: str) -> None:
        """Flushes an attempt. Not to be repeated after an error, which is told once."""
        with self._explained(staging):
            tree = self._open.pop(staging, None)
            if tree is None:
                return sync_tree(self.path(staging))
            try:
                tree.flush(self.root)
            finally:
                tree.close()

    def put_if_absent(self, key: str, data: bytes, staging: str | None = None) -> bool:
        """Links a finished temporary file to `key`: the one step that refuses a second writer."""
        return not os.path.exists(self._at(key)) and self._place(os.link, key, data, staging)

    def write_whole(self, key: str, data: bytes, durable: bool = True) -> None:
        """Renames a finished temporary file to `key`."""
        self._place(os.replace, key, data, durable=durable)

    def rename(self, source: str, target: str, plain: set[str] | None = None) -> None:
        """Moves a file; makes the target's folder where it is missing."""
        old, new = self._own(source, plain), self._own(target, plain)
        with self._explained(target):
            try:
                os.replace(old, new)
            except FileNotFoundError:
                os.makedirs(os.path.dirname(new), exist_ok=True)
                os.replace(old, new)

    def sync_folders_of(self, keys: Iterable[str]) -> None:
        """Flushes the folders that hold `keys`, up to the output folder."""
        holders = {key.rpartition("/")[0] for key in keys}
        folders = {".", *holders, *(folder for holder in holders for folder in _folders_above(holder))} - {""}
        with self._explained("the output folder"):
            sync_folders(self.root, folders)

    def fence(self, staging: str) -> None:
        """Renames an attempt's folder: from then on the attempt cannot write, nor link a record."""
        with contextlib.suppress(FileNotFoundError):
            os.rename(self._own(staging), self.path(staging + FENCED))
            sync_path(self.path(staging).parent)

    def is_fenced(self, staging: str) -> bool:
        """Whether the attempt's folder has gone from its name."""
        return not self.path(staging).is_dir()

    def read(self, key: str) -> bytes:
        """The bytes at `key`."""
        with open(self._at(key), "rb") as file:
            return file.read()

    def size(self, key: str) -> int | None:
        """Bytes at `key`, or None."""
        found = self._stat(key)
        return found.st_size if found else None

    def modified(self, key: str) -> float | None:
        """Modification time at `key`, or None."""
        found = self._stat(key)
        return found.st_mtime if found else None

    def files(self, prefix: str) -> Iterator[Entry]:
        """Every file below `prefix`; one that vanishes meanwhile is left out."""
        for entry in self._scan(prefix):
            key = f"{prefix}/{entry.name}" if prefix else entry.name
            if entry.is_dir(follow_symlinks=False):
                yield from self.files(key)
            elif (size := self.size(key)) is not None:
                yield Entry(key, size)

    def scan(self, prefix: str, sizes: bool = False) -> Iterator[tuple[str, int]]:
        """Names, and sizes if asked; one that vanishes meanwhile may be left out."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(self.path(prefix)) as entries:
            for entry in entries:
                with contextlib.suppress(FileNotFoundError):
                    yield entry.name, entry.stat().st_size if sizes else 0

    def children(self, prefix: str) -> list[str]:
        """Folders directly below `prefix`."""
        return [entry.name for entry in self._scan(prefix) if entry.is_dir(follow_symlinks=False)]

    def names(self, prefix: str) -> list[str]:
        """Everything directly below `prefix`."""
        return [entry.name for entry in self._scan(prefix)]

    def remove(self, key: str) -> None:
        """Removes a file."""
        with self._explained(key), contextlib.suppress(FileNotFoundError):
            os.unlink(self._own(key))

    def remove_tree(self, prefix: str) -> None:
        """Removes a folder; two processes may do so at once."""
        if tree := self._open.pop(prefix, None):
            tree.close()
        with self._explained(prefix):
            shutil.rmtree(self._own(prefix), onerror=ignore_missing)

    def remove_empty(self, prefix: str) -> None:
        """Removes an empty folder."""
        with contextlib.suppress(OSError):
            os.rmdir(self._own(prefix))

    @contextlib.contextmanager
    def scratch(self, name: str) -> Iterator[Path]:
        """A folder under `_staging/`, on the file system of its files' final names; an earlier one of the name goes."""
        key = f"{scratch_path(name)}/{uuid.uuid4().hex}"
        self.drop_scratch(name)
        try:
            with self._explained(f"a file of the {name}"):
                os.makedirs(self._own(key))
                yield self.path(key)
        finally:
            self.remove_tree(key)
            self.remove_empty(scratch_path(name))

    def drop_scratch(self, name: str) -> None:
        """Takes the folder away from whoever uses it: first its name, in one step, then its contents."""
        prefix = scratch_path(name)
        with contextlib.suppress(FileNotFoundError):
            os.rename(self._own(prefix), self.path(f"{prefix}.{uuid.uuid4().hex}"))
        for other in self.children(STAGING):
            if f"{STAGING}/{other}".startswith(f"{prefix}."):
                self.remove_tree(f"{STAGING}/{other}")

    def install(self, local: Path, key: str, over: Version | None = None) -> Version | None:
        """Flushes a file and renames it to `key`."""
        with self._explained(key):
            sync_path(local)
            os.makedirs(os.path.dirname(self._own(key)), exist_ok=True)
            os.replace(local, self.path(key))
            sync_path(self.path(key).parent)
        return None

    def withdraw(self, key: str, folder: Path) -> None:
        """Renames a file into a scratch folder."""
        with self._explained(key):
            os.replace(self._own(key), folder / uuid.uuid4().hex)

    def _place(
        self, name_it: Callable, key: str, data: bytes, staging: str | None = None, durable: bool = True
    ) -> bool:
        """Writes a temporary file and gives it the name `key` by `name_it`, os.link or os.replace.

        False where another file has the name. Raises FileNotFoundError where `staging` was swept.
        """
        target = self._own(key)

        def place_once() -> bool:
            with temporary_file(self.path(staging or TEMPORARY), data, durable) as temporary:
                try:
                    name_it(temporary, target)
                except FileExistsError:
                    # Over NFS a link whose first answer was lost is refused although it is ours.
                    return os.path.samefile(temporary, target)
                if durable:
                    sync_path(os.path.dirname(target))
            return True

        with self._explained(key):
            for folder in {os.path.dirname(target)} if staging else {os.path.dirname(target), self._at(TEMPORARY)}:
                os.makedirs(folder, exist_ok=True)
            return retry_if_swept(place_once)

    def _stat(self, key: str) -> os.stat_result | None:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return os.stat(self._at(key))
        return None

    def _scan(self, prefix: str) -> list[os.DirEntry[str]]:
        """What is directly below a folder, by name; nothing where there is no folder."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return sorted(os.scandir(self.path(prefix)), key=lambda entry: entry.name)
        return []

    def _explained(self, key: str) -> contextlib.AbstractContextManager[None]:
        return explain_disk_errors(f"{key} in {self.name} could not be written")


def _folders_above(path: str) -> list[str]:
    """The folders on the way to a file, the nearest first."""
    parts = path.split("/")
    return ["/".join(parts[:end]) for end in range(len(parts) - 1, 0, -1)]
