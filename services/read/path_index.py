"""Every path that a dataset's commits name, in an SQLite file: a constant amount of memory for any number of them."""

import contextlib
import os
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path

from schemas.errors import MachineError
from services.merge.shared import open_scratch

_TABLE = "CREATE TABLE paths (path BLOB PRIMARY KEY, sha256 TEXT) WITHOUT ROWID"


class PathIndex:
    """Takes paths with their SHA-256 in any order, and answers whether a path is among them."""

    def __init__(self, folder: Path) -> None:
        with _explained():
            self._db = open_scratch(folder / "paths.sqlite", _TABLE)

    def add(self, path: str, sha256: str = "") -> str | None:
        """Takes a path; the SHA-256 that it was given before, None where it is new."""
        key = os.fsencode(path)
        with _explained():
            known = self._db.execute("SELECT sha256 FROM paths WHERE path = ?", (key,)).fetchone()
            if known is None:
                self._db.execute("INSERT INTO paths VALUES (?, ?)", (key, sha256))
        return known[0] if known else None

    def add_all(self, paths: Iterable[str]) -> None:
        """Takes paths without digests."""
        with _explained():
            rows = ((os.fsencode(path),) for path in paths)
            self._db.executemany("INSERT INTO paths VALUES (?, '') ON CONFLICT DO NOTHING", rows)

    def __contains__(self, path: str) -> bool:
        with _explained():
            found = self._db.execute("SELECT 1 FROM paths WHERE path = ?", (os.fsencode(path),))
            return found.fetchone() is not None

    def close(self) -> None:
        """Closes the file."""
        self._db.close()


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise MachineError(
            f"the list of a dataset's files could not be kept in the temporary folder: {error}; free some space there, "
            "or set TMPDIR to a folder with more"
        ) from error
