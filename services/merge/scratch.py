"""The folder of a merge, its SQLite files with a cache of a fixed size, and what a full disk says to a user."""

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from schemas.errors import MachineError, RunError
from workers.store.store import Store

SCRATCH = "merge"
"""The name of the folder."""
CACHE_KIB = 16 << 10
"""Memory for SQLite's cache."""


@contextlib.contextmanager
def merge_folder(store: Store) -> Iterator[Path]:
    """An empty folder for the files of a merge; that of an earlier merge goes first, wherever that merge is.

    Raises MachineError where a file in it cannot be written, RunError where it is taken away in turn.
    """
    try:
        with explain_full_disk(), store.scratch(SCRATCH) as folder:
            yield folder
    except (MachineError, FileNotFoundError) as error:
        if store.root is not None and not store.root.is_dir():
            raise MachineError(f"{store.name} was removed while it was merged") from error
        if isinstance(error, FileNotFoundError):
            raise RunError(
                f"{error.filename or SCRATCH} was removed while {store.name} was merged: another coordinator merges here; "
                "start again when it has ended"
            ) from error
        raise


def open_scratch(path: Path, tables: str) -> sqlite3.Connection:
    """A new SQLite file with these tables. No journal and no flush: whoever comes later begins with a new file."""
    # No other process opens the file, and file locks may be missing on a network drive.
    uri = f"{path.absolute().as_uri()}?nolock=1"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None)
    try:
        connection.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
        connection.executescript(f"PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; {tables}; BEGIN;")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


@contextlib.contextmanager
def explain_full_disk() -> Iterator[None]:
    """Turns an error of SQLite or of writing a file into a MachineError. A file that is gone stays FileNotFoundError."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (sqlite3.Error, OSError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else error
        raise MachineError(
            f"the merge could not write its files: {reason}; free some space and start again, nothing finished is lost"
        ) from error
