"""The operations on a dataset's place that the commit protocol is built on, for a disk and for an object store.

A key is a path below the output folder with `/` between its parts. Everything unfinished lies under `_staging/`. Every
other key appears whole, in one step: by `put_if_absent`, `write_whole`, `rename` or `install`.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, NamedTuple, Protocol, TypeVar

T = TypeVar("T")


def retry_if_swept(step: Callable[[], T]) -> T:
    """The result of `step`, called up to three times: another coordinator may sweep its temporary file in between.

    Raises FileNotFoundError where the last call does.
    """
    for _ in range(2):
        with contextlib.suppress(FileNotFoundError):
            return step()
    return step()


class Entry(NamedTuple):
    """A stored file."""

    key: str
    bytes: int


class Version(NamedTuple):
    """A file as it is now."""

    bytes: int
    tag: str | None
    """Of an object: differs for every content. None on a disk."""


class Store(Protocol):
    """A place that holds a dataset. Every write raises MachineError where the place is full or broken."""

    name: str
    """The place, as a user writes it."""
    root: Path | None
    """The output folder on a disk of this machine, None for an object store."""
    tar_only: bool
    """True where a file for each image would be too many."""
    fence_is_final: bool
    """True where a fenced attempt can no longer commit; False where it still may, if it was just about to."""

    def prepare(self) -> None:
        """Makes the output folder and proves `put_if_absent`. Raises OutputError naming the place and a remedy."""

    def open_staging(self, staging: str) -> None:
        """Makes the folder of an attempt, the only place that the attempt writes."""

    def write_staged(self, staging: str, path: str, data: bytes) -> None:
        """Writes `staging/path`. Raises FileNotFoundError where the folder was swept: it is never made anew."""
        with self.stream_staged(staging, path) as file:
            file.write(data)

    def stream_staged(self, staging: str, path: str) -> contextlib.AbstractContextManager[IO[bytes]]:
        """A writable file at `staging/path`, stored when the context ends without an error. Raises as `write_staged`."""

    def write_note(self, staging: str, path: str, data: bytes) -> None:
        """Writes `staging/path` anew, with as many bytes as every time. Raises as `write_staged`."""
        self.write_staged(staging, path, data)

    def make_durable(self, staging: str) -> None:
        """Returns when everything under `staging` survives a loss of power. By default, writes are durable at once."""
        return

    def put_if_absent(self, key: str, data: bytes, staging: str | None = None) -> bool:
        """Stores `data` whole and durably at `key` unless something is there; False where something else is.

        With `staging`, raises FileNotFoundError if that folder was swept first. A disk always detects that; an object
        store may miss a sweep at the same moment.
        """

    def write_whole(self, key: str, data: bytes, durable: bool = True) -> None:
        """Puts `data` at `key` in one step, replacing what was there."""

    def rename(self, source: str, target: str, plain: set[str] | None = None) -> None:
        """Moves a file, replacing the target in one step. Raises FileNotFoundError where the source is gone.

        `plain` collects folders that were found to lead nowhere else: calls that share it ask each of them once.
        """

    def sync_folders_of(self, keys: Iterable[str]) -> None:
        """Returns when the names `keys` survive a loss of power. By default, names are durable at once."""
        return

    def fence(self, staging: str) -> None:
        """Takes an attempt's folder, if there is one, out of the attempt's reach for good (to a name with FENCED on a disk).

        With `fence_is_final`, a fenced attempt can neither write nor commit.
        """

    def is_fenced(self, staging: str) -> bool:
        """Whether an attempt lost its folder, or the mark in it, to `fence`."""

    def read(self, key: str) -> bytes:
        """The bytes at `key`. Raises FileNotFoundError."""

    def size(self, key: str) -> int | None:
        """Bytes of the file at `key`, None where there is none."""

    def modified(self, key: str) -> float | None:
        """When the file at `key` was written, seconds since 1970 by the place's clock; None where there is none."""

    def files(self, prefix: str) -> Iterator[Entry]:
        """Every file at any depth below the folder `prefix`, in the order of the keys' parts."""

    def versions(self, folders: Iterable[str], keys: Iterable[str]) -> dict[str, Version]:
        """By key: every file at any depth below the folders, and those of `keys` that are there."""
        entries = [entry for folder in folders for entry in self.files(folder)]
        single = ((key, self.size(key)) for key in keys)
        return {key: Version(size, None) for key, size in (*entries, *single) if size is not None}

    def listing(self) -> Iterator[Entry]:
        """Every file there is, in any order; of an object store a page at a time."""
        yield from self.files("")

    def scan(self, prefix: str, sizes: bool = False) -> Iterator[tuple[str, int]]:
        """(name, bytes) of everything directly below the folder `prefix`, one at a time, in any order.

        Bytes are 0 unless `sizes` asks for them: a listing without is several times as fast on a disk.
        """

    def children(self, prefix: str) -> list[str]:
        """Names of the folders directly below `prefix`, sorted."""

    def names(self, prefix: str) -> list[str]:
        """Names of the files and folders directly below `prefix`, sorted."""

    def remove(self, key: str) -> None:
        """Removes a file, if there is one."""

    def remove_tree(self, prefix: str) -> None:
        """Removes a folder with its contents, if there is one."""

    def remove_empty(self, prefix: str) -> None:
        """Removes a folder if it is empty. By default there are no folders."""
        return

    def scratch(self, name: str) -> contextlib.AbstractContextManager[Path]:
        """An empty folder on a local disk whose files `install` can move into place; removed afterwards."""

    def drop_scratch(self, name: str) -> None:
        """Removes what killed processes left of scratch folders of this name; on a disk, those in use too."""

    def install(self, local: Path, key: str, over: Version | None = None) -> Version | None:
        """Moves a finished file of a scratch folder to `key` in one step, durably, replacing what was there.

        Raises FileNotFoundError where the scratch folder was taken away (a disk), RunError where there is something else
        than `over`, None for nothing (an object store). An object's version comes back where it is surely this call's.
        """

    def withdraw(self, key: str, folder: Path) -> None:
        """Takes a file away, if there is one: on a disk into a scratch folder, which must still be there."""
        self.remove(key)
