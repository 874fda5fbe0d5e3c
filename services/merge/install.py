"""Putting of merged files into their places, in one order that a kill or another merge cannot turn into a mix."""

import contextlib
import functools
import hashlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyarrow.parquet as pq

from schemas.dataset.layout import CAM_POSES, CAMERAS, MANIFEST, OBJECTS, SUCCESS_FILE, is_merged_path
from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import VersoError
from services.merge.reading import map_ahead
from workers.store.manifest import PARQUET_OPTIONS
from workers.store.store import Store, Version

_FOLDERS = tuple(f"{MANIFEST}/{table}" for table in TABLES)
_SINGLE = (CAM_POSES, CAMERAS, OBJECTS)

AT_ONCE = 4
"""Files that are put at once into an object store; each is in memory meanwhile."""


def file_entry(path: Path) -> dict[str, object]:
    """Size and SHA-256 of a file, as `_SUCCESS` has them."""
    with open(path, "rb") as file:
        return {"bytes": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


class Installation:
    """Replaces an older merge by this one, file by file and `_SUCCESS` last; a context that undoes what it can on an error.

    `require_unchanged` raises RunError where another process works here. It is asked after what is there was listed, and
    before anything is replaced.
    """

    def __init__(self, store: Store, folder: Path, require_unchanged: Callable[[], None]) -> None:
        self._store = store
        self._folder = folder
        self._require_unchanged = require_unchanged
        self._new: dict[str, Version] = {}
        """Objects that were put where there was nothing."""

    def __enter__(self) -> "Installation":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Where a merge is refused, rows of its new files must not stay beside a newer merge that does not have them."""
        if kind is None or not issubclass(kind, VersoError):
            return
        for key, mine in self._new.items():
            with contextlib.suppress(VersoError):
                if key.endswith(".parquet"):
                    self._store.install(_empty_table(self._folder, key), key, mine)

    def put_files(self, files: Mapping[str, Path]) -> dict[str, dict[str, object]]:
        """Takes `_SUCCESS` away, then puts the files into their places; older ones that have no successor go.

        An object store cannot delete on a condition. There an empty table takes the place of such a file; the entries of
        these come back. Raises RunError where another merge replaced a file meanwhile.
        """
        store = self._store
        before = store.versions(_FOLDERS, [*_SINGLE, SUCCESS_FILE])
        self._require_unchanged()
        if before.pop(SUCCESS_FILE, None) is not None:
            store.withdraw(SUCCESS_FILE, self._folder)
            store.sync_folders_of([SUCCESS_FILE])
        stale = sorted(before.keys() - files.keys())
        emptied = {}
        for key in stale:
            if store.root is None and is_merged_path(key):
                emptied[key] = _empty_table(self._folder, key)
            else:
                store.withdraw(key, self._folder)
                store.remove_empty(key.rpartition("/")[0])
        with ThreadPoolExecutor(AT_ONCE) as pool:
            spread = functools.partial(map_ahead, pool, window=AT_ONCE) if store.root is None else map
            for _ in spread(
                lambda item: self._put(item[0], item[1], before.get(item[0])), {**emptied, **files}.items()
            ):
                pass
        store.sync_folders_of([*files, *stale])
        return {key: file_entry(path) for key, path in emptied.items()}

    def put_success(self, data: bytes) -> None:
        """Writes `_SUCCESS`. Raises RunError where another merge wrote it, or took this merge's folder away."""
        local = self._folder / SUCCESS_FILE
        local.write_bytes(data)
        before = self._store.versions((), (SUCCESS_FILE,))
        self._require_unchanged()
        self._store.install(local, SUCCESS_FILE, before.get(SUCCESS_FILE))

    def _put(self, key: str, local: Path, before: Version | None) -> None:
        now = self._store.install(local, key, before)
        if now is not None and before is None:
            self._new[key] = now


def sizes_agree(store: Store, files: Mapping[str, Mapping[str, object]]) -> bool:
    """Whether these files are there with their sizes, and no others where merged files are."""
    found = store.versions(_FOLDERS, _SINGLE)
    return {key: version.bytes for key, version in found.items()} == {key: file["bytes"] for key, file in files.items()}


def _empty_table(folder: Path, key: str) -> Path:
    """A file with the schema of the table that `key` belongs to."""
    table = key.split("/")[1]
    schema = SCHEMAS[table]
    path = folder / f"empty-{table}.parquet"
    pq.write_table(schema.remove(schema.get_field_index("category")).empty_table(), path, **PARQUET_OPTIONS)
    return path
