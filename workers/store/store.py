"""Where a dataset lives: the few operations that the commit protocol stands on.

A key is a path below the output folder with `/` between its parts. Everything unfinished lies under `_staging/`; the
only other place where a key appears is by `put_if_absent`, `write_whole`, `rename` or `install`: whole, in one step.
"""

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, NamedTuple, Protocol

from schemas.dataset.layout import STAGING

TEMPORARY = f"{STAGING}/_tmp"
"""Files on their way to `put_if_absent` and `write_whole`; one that a killed process left is swept."""

PROBE_PREFIX = ".probe-"
"""Names that a killed probe may leave in `_tmp` and beside the commits; they are swept."""


def fenced_key(staging: str) -> str:
    """Where the folder of a fenced attempt lies."""
    return f"{staging}.fenced"


class Entry(NamedTuple):
    """A stored file."""

    key: str
    bytes: int


class Store(Protocol):
    """What a place must offer to hold a dataset. Every write raises MachineError where the place is full or broken."""

    name: str
    """The place, as a user writes it."""
    tar_only: bool
    """True where a file of its own for each image would be too many."""

    def prepare(self) -> None:
        """Makes the output folder and proves the primitive. Raises OutputError naming the place and a remedy."""

    def open_staging(self, staging: str) -> None:
        """Makes the folder of an attempt, the only place that it writes."""

    def write_staged(self, staging: str, path: str, data: bytes) -> None:
        """Writes `staging/path`. Raises FileNotFoundError where the folder was swept: it is never made anew."""

    def stream_staged(self, staging: str, path: str) -> contextlib.AbstractContextManager[IO[bytes]]:
        """A writable file at `staging/path`, stored when the context ends without an error; as `write_staged`."""

    def make_durable(self, staging: str) -> None:
        """Returns when all that was written under `staging` survives a loss of power."""

    def put_if_absent(self, key: str, data: bytes, staging: str | None = None) -> bool:
        """Stores `data` whole and durably at `key` unless something is there; False where something else is.

        With `staging`, raises FileNotFoundError if that folder was swept first. A disk is always right about that; an
        object store may miss a sweep that happens in the same moment.
        """

    def write_whole(self, key: str, data: bytes, durable: bool = True) -> None:
        """Puts `data` at `key` in one step, replacing what was there."""

    def rename(self, source: str, target: str) -> None:
        """Moves a file, replacing the target in one step. Raises FileNotFoundError where the source is gone."""

    def sync_folders_of(self, keys: Iterable[str]) -> None:
        """Returns when the names `keys` survive a loss of power."""

    def fence(self, staging: str) -> str | None:
        """Moves an attempt's folder, once and for all, to `fenced_key`, out of its reach; None where there was nothing.

        On a disk, an attempt that is fenced can neither write nor commit.
        """

    def read(self, key: str) -> bytes:
        """The bytes at `key`. Raises FileNotFoundError."""

    def size(self, key: str) -> int | None:
        """Bytes of the file at `key`, None where there is none."""

    def modified(self, key: str) -> float | None:
        """When the file at `key` was written, seconds since 1970 by the place's clock; None where there is none."""

    def files(self, prefix: str) -> Iterator[Entry]:
        """Every file at any depth below the folder `prefix`, in the order of their keys' parts."""

    def children(self, prefix: str) -> list[str]:
        """Names of the folders directly below `prefix`, sorted."""

    def remove(self, key: str) -> None:
        """Removes a file; nothing happens where there is none."""

    def remove_tree(self, prefix: str) -> None:
        """Removes a folder with all in it; nothing happens where there is none."""

    def remove_empty(self, prefix: str) -> None:
        """Removes a folder if nothing is in it."""

    def scratch(self, name: str) -> contextlib.AbstractContextManager[Path]:
        """An empty folder on a local disk, removed afterwards, whose files `install` can move into place."""

    def install(self, local: Path, key: str) -> None:
        """Moves a finished local file to `key` in one step, durably, replacing what was there."""
