"""The verbs of a dataset's place, the same for a folder and for an object store, and what is made of them alone.

A key is a path below the output folder with `/` between its parts. Everything unfinished lies under `_staging/`. Every
other key appears whole, in one step: by `put`, `put_if_absent`, `move` or `replace`.
"""

import contextlib
import io
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import IO, NamedTuple, Protocol, TypeVar

from schemas.dataset.layout import BEGUN
from schemas.errors import CorruptError

A = TypeVar("A")
B = TypeVar("B")


class Entry(NamedTuple):
    """A stored file as it is now."""

    key: str
    bytes: int
    modified_s: float
    """When it was written, seconds since 1970 by the place's clock."""
    tag: str | None
    """Of an object: differs for every content. None on a disk."""


class Stage(Protocol):
    """An attempt's folder, the only place that the attempt writes.

    It is never made anew: once a disk's is revoked, every method raises FileNotFoundError.
    """

    def stream(self, path: str) -> contextlib.AbstractContextManager[IO[bytes]]:
        """A writable file at `path` below the folder, stored when the context ends without an error."""

    def write(self, path: str, data: bytes) -> None:
        """Stores `data` at `path` below the folder; over an earlier file only where that has as many bytes."""
        with self.stream(path) as file:
            file.write(data)

    def flush(self) -> None:
        """Returns when everything in the folder survives a loss of power. Not to be called again after an error."""
        return  # what an object store has put does

    def put_if_absent(self, key: str, data: bytes) -> bool:
        """`Store.put_if_absent`, unless the folder was revoked. An object store may miss a revocation at the same moment."""

    def close(self) -> None:
        """Frees what the stage holds of this process; its files stay."""
        return


class Store(Protocol):
    """A place that holds a dataset. Every write raises MachineError where the place is full or broken."""

    name: str
    """The place, as a user writes it."""
    root: Path | None
    """The output folder on a disk of this machine, for what only a disk has; None for an object store."""
    layouts: tuple[str, ...]
    """The values of `output.layout` that the place can hold: a file for each image is too many for an object store."""
    at_once: int
    """Requests that are worth having under way at once: 1 where they do not wait for a network."""

    def prepare(self) -> None:
        """Makes the output folder and proves `put_if_absent`. Raises OutputError naming the place and a remedy."""

    def read(self, key: str) -> bytes:
        """The bytes at `key`. Raises FileNotFoundError."""

    def open(self, key: str) -> io.BufferedIOBase:
        """A file that gives the bytes at `key`, of a disk a part at a time. Raises FileNotFoundError."""
        return io.BytesIO(self.read(key))

    def stat(self, key: str) -> Entry | None:
        """The file at `key`, None where there is none."""

    def size(self, key: str) -> int | None:
        """Bytes of the file at `key`, None where there is none."""
        entry = self.stat(key)
        return entry.bytes if entry else None

    def files(self, prefix: str, sizes: bool = True) -> Iterator[Entry]:
        """Every file at any depth below the folder `prefix` (all there are for ""), in any order, one at a time.

        Without `sizes`, a disk gives names alone, several times as fast; other fields are 0.
        """

    def names(self, prefix: str) -> list[str]:
        """Names of the files and folders directly below `prefix`, sorted."""

    def children(self, prefix: str) -> list[str]:
        """Names of the folders directly below `prefix`, sorted."""

    def put(self, key: str, data: bytes, durable: bool = True) -> None:
        """Puts `data` at `key` in one step, replacing what was there."""

    def put_if_absent(self, key: str, data: bytes) -> bool:
        """Stores `data` whole and durably at `key` unless something is there; False where something else is."""

    def move(self, source: str, target: str) -> None:
        """Moves a file, replacing the target in one step. Raises FileNotFoundError where the source is gone."""

    def sync(self, keys: Iterable[str]) -> None:
        """Returns when the names `keys` survive a loss of power."""
        return

    def remove(self, key: str) -> None:
        """Removes a file, if there is one."""

    def remove_tree(self, prefix: str) -> None:
        """Removes a folder with its contents, if there is one."""

    def remove_empty(self, prefix: str) -> None:
        """Removes a folder if it is there and empty."""
        return

    def stage(self, staging: str) -> Stage:
        """Begins an attempt in the folder `staging`."""

    def revoke(self, staging: str) -> bool:
        """Takes an attempt's folder, if there is one, out of the attempt's reach for good.

        A disk gives it a name that ends in FENCED. True where the attempt can no longer commit; False where it still may, if
        it was just about to.
        """

    def scratch(self, name: str) -> contextlib.AbstractContextManager[Path]:
        """An empty folder on a local disk for the files of `replace`, removed afterwards.

        What killed processes left of folders of this name goes first; on a disk, so does one that is in use.
        """

    def replace(self, local: Path, key: str, over: Entry | None = None) -> Entry | None:
        """Moves a finished file of a scratch folder to `key` in one step, durably, replacing what was there.

        Raises FileNotFoundError where the scratch folder was taken away (a disk), RunError where there is something else
        than `over`, None for nothing (an object store). An object's entry comes back where it is surely this call's.
        """

    def withdraw(self, key: str, folder: Path) -> bool:
        """Takes a file away if `folder`, a scratch folder, is still there; False where the place has no such condition."""
        return False


def is_live(store: Store, staging: str) -> bool:
    """Whether an attempt has begun in this folder and was not revoked."""
    return store.stat(f"{staging}/{BEGUN}") is not None


def stat_all(store: Store, folders: Iterable[str], keys: Iterable[str]) -> dict[str, Entry]:
    """By key: every file at any depth below the folders, and those of `keys` that are there."""
    asked = [*((True, folder) for folder in folders), *((False, key) for key in keys)]
    answers = map_ahead(store, lambda item: [*store.files(item[1])] if item[0] else [store.stat(item[1])], asked)
    return {entry.key: entry for entries in answers for entry in entries if entry is not None}


def map_ahead(store: Store, function: Callable[[A], B], items: Iterable[A], at_once: int | None = None) -> Iterator[B]:
    """The results of `function` in the order of `items`; as many calls at once as the store is worth, `at_once` at most.

    Twice as many results are under way or wait. On a disk, items are taken one by one.
    """
    threads = min(store.at_once, at_once or store.at_once)
    if threads == 1:
        yield from map(function, items)
        return
    waiting: deque[Future[B]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) >= (at_once or 2 * threads):
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def retry_if_swept(step: Callable[[], B]) -> B:
    """The result of `step`, called up to three times: another coordinator may sweep its temporary file in between.

    Raises FileNotFoundError where the last call does.
    """
    for _ in range(2):
        with contextlib.suppress(FileNotFoundError):
            return step()
    return step()


LONGEST_PAUSE_S = 1.0
"""Between two tries to append: over NFS, a listing may be old for some seconds."""


class Events:
    """The numbered events below `folder`, files named by their number with eight digits.

    Each is put if absent at the next number, never changed, and state is the fold of them. Writers decide on what they read and
    take the next number; whoever loses it reads and decides again. So no two events are decided on the same state, however many
    processes and machines append, and no clock is compared.
    """

    def __init__(self, store: Store, folder: str) -> None:
        self._store = store
        self._folder = folder
        self._known: list[bytes] = []
        """Events that were read: they never change."""

    def read(self) -> list[bytes]:
        """All events from the first. Raises CorruptError where one is missing, or the folder holds what is none."""
        names = self._store.names(self._folder)
        if names != [event_path("", number)[1:] for number in range(len(names))]:
            raise CorruptError(f"{self._store.name}/{self._folder} lacks an event, or holds what is none")
        self._known += [self._read(f"{self._folder}/{name}") for name in names[len(self._known) :]]
        return self._known[: len(names)]

    def _read(self, key: str) -> bytes:
        return self._store.read(key)

    def append(self, decide: Callable[[Sequence[bytes]], bytes | None]) -> list[bytes] | None:
        """Adds the event that `decide` makes of all events before it, and returns all; None where it makes none.

        `decide` is called again where another writer took the number. Two writers must never make the same bytes: an event
        needs a nonce.
        """
        pause_s = 0.01
        while True:
            before = self.read()
            event = decide(before)
            if event is None:
                return None
            if self._store.put_if_absent(event_path(self._folder, len(before)), event):
                return [*before, event]
            time.sleep(pause_s)
            pause_s = min(LONGEST_PAUSE_S, 2 * pause_s)


def event_path(folder: str, number: int) -> str:
    """The key of event `number`, from 0, of the log in a folder; keys sort as their numbers."""
    return f"{folder}/{number:08d}.json"
