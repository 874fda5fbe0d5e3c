"""Scratch tables of a merge: SQLite files with a cache of a fixed size, and what a full disk says to a user."""

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from schemas.errors import MachineError

CACHE_KIB = 16 << 10
"""Memory for SQLite's cache."""


def open_scratch(path: Path, tables: str) -> sqlite3.Connection:
    """A new SQLite file with these tables. No journal and no flush: another merge begins with a new file."""
    # No other process opens the file, and file locks may be missing on a network drive.
    uri = f"{path.absolute().as_uri()}?nolock=1"
    with explain_full_disk():
        connection = sqlite3.connect(uri, uri=True, isolation_level=None)
        connection.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
        connection.executescript(f"PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; {tables}; BEGIN;")
    return connection


@contextlib.contextmanager
def explain_full_disk() -> Iterator[None]:
    """Turns an error of SQLite or of writing a file into a MachineError."""
    try:
        yield
    except (sqlite3.Error, OSError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else error
        raise MachineError(
            f"the merge could not write its files: {reason}; free some space and start again, nothing finished is lost"
        ) from error
