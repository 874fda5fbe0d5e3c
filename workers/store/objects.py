"""A dataset in an object store: records by conditional put, everything else by plain puts, copies and deletes.

An object appears whole or not at all, and a put that has returned is durable. What a disk can do and this cannot: take
a folder away from an attempt in one step. So an attempt here is only swept when its worker is known to be dead.
"""

import contextlib
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, NotSupportedError
from obstore.store import from_url

from schemas.errors import MachineError, OutputError
from workers.store.store import PROBE_PREFIX, TEMPORARY, Entry, fenced_key

_PROBES = 3
"""A coordinator that already works here may sweep a probe away between its two puts."""

_BEGUN = "_begun"
"""In an attempt's folder from its beginning until it is swept."""


def open_object_store(url: str) -> "ObjectStore":
    """The store at `url`, such as s3://bucket/path; keys, regions and endpoints come from the cloud's own settings.

    Raises OutputError where the URL names no store that is known or lacks something.
    """
    try:
        return ObjectStore(from_url(url), url)
    except (BaseError, ValueError) as error:
        raise OutputError(f"{url} is not an object store that can be opened: {_first_line(error)}") from error


class ObjectStore:
    """A bucket, or a prefix in one."""

    tar_only = True

    def __init__(self, bucket: obstore.store.ObjectStore, name: str) -> None:
        self._bucket = bucket
        self.name = name

    def prepare(self) -> None:
        """Proves that a put can be refused where something is (see `Store`)."""
        try:
            refused = any(self._refuses_a_second_put() for _ in range(_PROBES))
        except (NotSupportedError, NotImplementedError) as error:
            raise OutputError(self._unfit()) from error
        except (BaseError, OSError) as error:
            raise OutputError(f"{self.name} cannot be written: {_first_line(error)}") from error
        if not refused:
            raise OutputError(self._unfit())

    def _refuses_a_second_put(self) -> bool:
        key = f"{TEMPORARY}/{PROBE_PREFIX}{uuid.uuid4().hex}"
        obstore.put(self._bucket, key, b"first", mode="create")
        try:
            obstore.put(self._bucket, key, b"second", mode="create")
        except AlreadyExistsError:
            return True
        finally:
            self.remove(key)
        return False

    def open_staging(self, staging: str) -> None:
        """Marks the attempt as begun."""
        self._put(f"{staging}/{_BEGUN}", b"")

    def write_staged(self, staging: str, path: str, data: bytes) -> None:
        """Puts an object of an attempt."""
        self._put(f"{staging}/{path}", data)

    @contextlib.contextmanager
    def stream_staged(self, staging: str, path: str) -> Iterator[IO[bytes]]:
        """A temporary file on the local disk, put as one object in the end (see `Store`)."""
        with tempfile.TemporaryFile() as file:
            yield file
            file.seek(0)
            with self._told(path):
                obstore.put(self._bucket, f"{staging}/{path}", file)

    def make_durable(self, staging: str) -> None:
        """Nothing is left to do: puts are durable."""

    def put_if_absent(self, key: str, data: bytes, staging: str | None = None) -> bool:
        """Puts on the condition that nothing is there (see `Store`).

        A put whose answer was lost is sent again underneath and then refused: what is there tells whether it is ours,
        because no two callers ever put the same bytes at one key.
        """
        if staging is not None and self.size(f"{staging}/{_BEGUN}") is None:
            raise FileNotFoundError(f"{staging} was swept")
        try:
            with self._told(key):
                obstore.put(self._bucket, key, data, mode="create")
        except AlreadyExistsError:
            return self.read(key) == data
        return True

    def write_whole(self, key: str, data: bytes, durable: bool = True) -> None:
        """Puts an object over what was there."""
        self._put(key, data)

    def rename(self, source: str, target: str) -> None:
        """Copies, then deletes: a kill in between leaves both, and doing it again mends it."""
        with self._told(target):
            obstore.copy(self._bucket, source, target)
        self.remove(source)

    def sync_folders_of(self, keys: Iterable[str]) -> None:
        """Nothing is left to do: puts are durable."""

    def fence(self, staging: str) -> str | None:
        """Takes away the mark without which an attempt does not commit. Its objects stay where they are."""
        if self.size(f"{staging}/{_BEGUN}") is None:
            return None
        self.remove(f"{staging}/{_BEGUN}")
        return fenced_key(staging)

    def read(self, key: str) -> bytes:
        """The bytes at `key` (see `Store`)."""
        with self._told(key):
            return bytes(obstore.get(self._bucket, key).bytes())

    def size(self, key: str) -> int | None:
        """Bytes at `key`, or None."""
        try:
            with self._told(key):
                return obstore.head(self._bucket, key)["size"]
        except FileNotFoundError:
            return None

    def modified(self, key: str) -> float | None:
        """When the object was put, or None."""
        try:
            with self._told(key):
                return obstore.head(self._bucket, key)["last_modified"].timestamp()
        except FileNotFoundError:
            return None

    def files(self, prefix: str) -> Iterator[Entry]:
        """Every object below `prefix`, in the order of their keys' parts."""
        with self._told(prefix):
            found = [
                Entry(meta["path"], meta["size"]) for batch in obstore.list(self._bucket, prefix) for meta in batch
            ]
        yield from sorted(found, key=lambda entry: entry.key.split("/"))

    def children(self, prefix: str) -> list[str]:
        """What stands for folders directly below `prefix`."""
        with self._told(prefix):
            found = obstore.list_with_delimiter(self._bucket, prefix)["common_prefixes"]
        return sorted(path.rpartition("/")[2] for path in found)

    def remove(self, key: str) -> None:
        """Deletes an object."""
        with self._told(key), contextlib.suppress(FileNotFoundError):
            obstore.delete(self._bucket, key)

    def remove_tree(self, prefix: str) -> None:
        """Deletes all objects below `prefix`; the mark of an attempt goes first."""
        self.remove(f"{prefix}/{_BEGUN}")
        for entry in self.files(prefix):
            self.remove(entry.key)

    def remove_empty(self, prefix: str) -> None:
        """There are no folders to remove."""

    @contextlib.contextmanager
    def scratch(self, name: str) -> Iterator[Path]:
        """A temporary folder of this machine."""
        with tempfile.TemporaryDirectory(prefix=f"verso-{name}-") as folder:
            yield Path(folder)

    def install(self, local: Path, key: str) -> None:
        """Puts a local file, in parts where it is large."""
        with self._told(key):
            obstore.put(self._bucket, key, local)

    def _put(self, key: str, data: bytes) -> None:
        with self._told(key):
            obstore.put(self._bucket, key, data)

    def _unfit(self) -> str:
        return (
            f"{self.name} does not refuse a second put where the first must stand: two workers could commit one range. "
            f"Use a store with conditional puts (S3, Google Cloud Storage, Azure, MinIO) or a folder"
        )

    @contextlib.contextmanager
    def _told(self, key: str) -> Iterator[None]:
        """Turns a store that does not answer into an error that says so."""
        try:
            yield
        except AlreadyExistsError:
            raise
        except BaseError as error:
            raise MachineError(f"{key} in {self.name}: {_first_line(error)}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
