"""A dataset in an object store: records by conditional put, everything else by plain puts, copies and deletes.

An object appears whole or not at all, and a put that has returned is durable. Unlike a disk, a store cannot take a
folder away from an attempt in one step: a fenced attempt that was about to commit may still do so. So its objects stay
until another attempt has committed the range.
"""

import contextlib
import functools
import tempfile
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, TypeVar

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, GenericError, NotSupportedError, PreconditionError
from obstore.store import from_url

from schemas.dataset.layout import BEGUN, PROBE_PREFIX, TEMPORARY
from schemas.errors import MachineError, OutputError, RunError
from workers.store.file_system import temporary_folder
from workers.store.store import Entry, Stage, Store, is_live

if TYPE_CHECKING:
    from obstore import PutMode, PutResult

T = TypeVar("T")

_TRIES = 3
"""How often a conditional put or a delete is made where no answer comes."""

_NOT_IMPLEMENTED = ("NotImplemented", "501 Not Implemented")
"""In the error of a store that refuses every conditional put."""

CONDITIONAL_BYTES = 64 << 20
"""Larger files are put in parts, which cannot be made conditional."""


def open_object_store(url: str) -> "ObjectStore":
    """The store at `url`, such as s3://bucket/path; keys, regions and endpoints come from the cloud's own settings.

    Raises OutputError where the URL names no store that is known or lacks something.
    """
    try:
        return ObjectStore(from_url(url), url)
    except (BaseError, ValueError) as error:
        raise OutputError(f"{url} is not an object store that can be opened: {_first_line(error)}") from error


class ObjectStore(Store):
    """A bucket, or a prefix in one: what is put is durable, and there are no folders. `Store` says what each verb promises."""

    root = None
    layouts = ("tar",)
    at_once = 16

    def __init__(self, bucket: obstore.store.ObjectStore, name: str) -> None:
        self._bucket = bucket
        self.name = name

    def prepare(self) -> None:
        """Proves that a put is refused where something is."""
        try:
            # A coordinator that already works here may sweep a probe away between its two puts.
            refused = any(self._refuses_a_second_put() for _ in range(3))
        except (BaseError, OSError, NotImplementedError) as error:
            known = isinstance(error, (NotSupportedError, NotImplementedError))
            if not known and not any(word in str(error) for word in _NOT_IMPLEMENTED):
                raise OutputError(f"{self.name} cannot be written: {_first_line(error)}") from error
            refused = False
        if not refused:
            raise OutputError(
                f"{self.name} does not refuse a second put where the first must stand: two workers could commit one range. "
                f"Use a store with conditional puts (S3, Google Cloud Storage, Azure, MinIO) or a folder"
            )

    def _refuses_a_second_put(self) -> bool:
        key = f"{TEMPORARY}/{PROBE_PREFIX}{uuid.uuid4().hex}"
        try:
            for data in (b"first", b"second"):
                _repeat_unanswered(functools.partial(obstore.put, self._bucket, key, data, mode="create"))
        except AlreadyExistsError:  # also of the first put, where its answer was lost
            return True
        finally:
            with contextlib.suppress(MachineError, NotImplementedError):  # what the store lacks is told by the puts
                self.remove(key)
        return False

    def put_if_absent(self, key: str, data: bytes) -> bool:
        """Puts on the condition that nothing is there.

        A put whose answer was lost is sent again, and then refused: what is there tells whether it is ours, because no
        two callers ever put the same bytes at one key.
        """
        try:
            with self._explained(key):
                _repeat_unanswered(lambda: obstore.put(self._bucket, key, data, mode="create"))
        except AlreadyExistsError:
            return self.read(key) == data
        return True

    def put(self, key: str, data: bytes, durable: bool = True) -> None:
        """Puts an object over what was there."""
        with self._explained(key):
            obstore.put(self._bucket, key, data)

    def _put_file(self, key: str, file: IO[bytes]) -> None:
        """Puts a file, in parts where it is large; again where the store no longer knows of the parts.

        It has joined them then, and the answer was lost.
        """
        for _ in range(_TRIES):
            file.seek(0)
            with contextlib.suppress(FileNotFoundError):
                obstore.put(self._bucket, key, file)
                return
        raise MachineError(f"{key} in {self.name}: the store lost the parts of an upload {_TRIES} times")

    def move(self, source: str, target: str) -> None:
        """Copies, then deletes: a kill in between leaves both, and a second call deletes the first."""
        with self._explained(target):
            obstore.copy(self._bucket, source, target)
        self.remove(source)

    def stage(self, staging: str) -> "ObjectStage":
        """Marks the attempt as begun."""
        return ObjectStage(self, staging)

    def revoke(self, staging: str) -> bool:
        """Removes the mark that an attempt looks for just before it commits. Its objects stay where they are."""
        self.remove(f"{staging}/{BEGUN}")
        return False

    def read(self, key: str) -> bytes:
        """The bytes at `key`."""
        with self._explained(key):
            return bytes(obstore.get(self._bucket, key).bytes())

    def stat(self, key: str) -> Entry | None:
        """Size, time and entity tag of an object."""
        with contextlib.suppress(FileNotFoundError), self._explained(key):
            return _entry(obstore.head(self._bucket, key))
        return None

    def files(self, prefix: str, sizes: bool = True) -> Iterator[Entry]:
        """Every object below `prefix`, a page at a time."""
        with self._explained(prefix or "the listing"):
            for page in obstore.list(self._bucket, prefix or None):
                yield from map(_entry, page)

    def children(self, prefix: str) -> list[str]:
        """Common prefixes of keys, directly below `prefix`."""
        with self._explained(prefix):
            below = obstore.list_with_delimiter(self._bucket, prefix)
        return sorted(path.rpartition("/")[2] for path in below["common_prefixes"])

    def names(self, prefix: str) -> list[str]:
        """Objects and common prefixes of keys, directly below `prefix`."""
        with self._explained(prefix):
            below = obstore.list_with_delimiter(self._bucket, prefix)
        paths = [*below["common_prefixes"], *(meta["path"] for meta in below["objects"])]
        return sorted(path.rpartition("/")[2] for path in paths)

    def remove(self, key: str) -> None:
        """Deletes an object."""
        with self._explained(key), contextlib.suppress(FileNotFoundError):
            _repeat_unanswered(lambda: obstore.delete(self._bucket, key))

    def remove_tree(self, prefix: str) -> None:
        """Deletes all objects below `prefix`; the mark of an attempt goes first."""
        self.remove(f"{prefix}/{BEGUN}")
        if keys := [entry.key for entry in self.files(prefix)]:
            with self._explained(prefix), contextlib.suppress(FileNotFoundError):
                _repeat_unanswered(lambda: obstore.delete(self._bucket, keys))

    def scratch(self, name: str) -> contextlib.AbstractContextManager[Path]:
        """A temporary folder of this machine."""
        return temporary_folder(name)

    def replace(self, local: Path, key: str, over: Entry | None = None) -> Entry | None:
        """Puts a local file on the condition that nothing else is there; where it is large, in parts, having asked before."""
        size = local.stat().st_size
        try:
            with self._explained(key):
                if size <= CONDITIONAL_BYTES:
                    put = self._put_over(local.read_bytes(), key, over)
                elif getattr(self.stat(key), "tag", None) == getattr(over, "tag", None):
                    put = obstore.put(self._bucket, key, local)
                else:
                    raise _replaced(key)
                return Entry(key, size, 0.0, put["e_tag"])
        except (AlreadyExistsError, PreconditionError, FileNotFoundError) as error:
            stored = self.stat(key)
            if stored is None or stored.bytes != size or self.read(key) != local.read_bytes():
                raise _replaced(key) from error
            return None  # an answer was lost, or another put the same

    def _put_over(self, data: bytes, key: str, over: Entry | None) -> "PutResult":
        mode: PutMode = "create" if over is None else {"e_tag": over.tag}
        try:
            return _repeat_unanswered(lambda: obstore.put(self._bucket, key, data, mode=mode, use_multipart=False))
        except NotImplementedError:  # the client of a folder knows no condition but absence
            return obstore.put(self._bucket, key, data)

    @contextlib.contextmanager
    def _explained(self, key: str) -> Iterator[None]:
        """Turns an error of the store into a MachineError that names it; a refused conditional put stays as it is."""
        try:
            yield
        except (AlreadyExistsError, PreconditionError):
            raise
        except BaseError as error:
            raise MachineError(f"{key} in {self.name}: {_first_line(error)}") from error


class ObjectStage(Stage):
    """The objects of an attempt; what each operation promises stands in `Stage`."""

    def __init__(self, store: ObjectStore, staging: str) -> None:
        self._store = store
        self._staging = staging
        self.write(BEGUN, b"")

    def write(self, path: str, data: bytes) -> None:
        """Puts an object."""
        self._store.put(f"{self._staging}/{path}", data)

    @contextlib.contextmanager
    def stream(self, path: str) -> Iterator[IO[bytes]]:
        """A temporary file on the local disk, put as one object in the end."""
        with tempfile.TemporaryFile() as file:
            yield file
            with self._store._explained(path):
                self._store._put_file(f"{self._staging}/{path}", file)

    def put_if_absent(self, key: str, data: bytes) -> bool:
        """Looks for the mark, then puts."""
        if not is_live(self._store, self._staging):
            raise FileNotFoundError(f"{self._staging} was swept")
        return self._store.put_if_absent(key, data)


def _entry(meta: "obstore.ObjectMeta") -> Entry:
    return Entry(meta["path"], meta["size"], meta["last_modified"].timestamp(), meta["e_tag"])


def _replaced(key: str) -> RunError:
    return RunError(
        f"{key} was replaced while this process was about to: another coordinator works here; start again when it has ended"
    )


def _repeat_unanswered(request: Callable[[], T]) -> T:
    """Makes a request again where no answer came in time, which obstore does itself for all but two kinds of requests."""
    for _ in range(_TRIES - 1):
        with contextlib.suppress(GenericError):
            return request()
    return request()


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
