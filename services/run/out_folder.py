"""Tells whether the output folder was removed or moved while a run worked in it. Edge."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from schemas.errors import CorruptError, MachineError, RunError, VersoError

REMOVAL_S = 3.0
"""Time for a removal to end: its first missing file is met before its last one is gone."""

LOOKS_LOST = (CorruptError, RunError, FileNotFoundError)
"""What a run meets in a folder that is just being removed."""


@contextlib.contextmanager
def explain_lost_folder(root: Path | None) -> Iterator[None]:
    """An error in the block that comes of the folder's removal is a MachineError that says so; nothing without a folder.

    Work in a folder that is gone fails in many ways: a file is not found, an attempt looks as if another coordinator had
    swept it. Parts of the folder may even have been made anew.
    """
    if root is None:
        yield
        return
    folder = os.open(root, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield
    except (VersoError, OSError) as error:
        lost = _how_lost(folder, root)
        deadline = time.monotonic() + REMOVAL_S
        while lost is None and type(error) in LOOKS_LOST and time.monotonic() < deadline:
            time.sleep(0.1)  # whoever removes it may not be done
            lost = _how_lost(folder, root)
        if lost:
            raise MachineError(f"{root} was {lost} while the run worked in it: {_REMEDIES[lost]}") from error
        raise
    finally:
        os.close(folder)


_REMEDIES = {
    "removed": "what it held is gone, start again to make it anew",
    "moved": "move it back and start again, what is committed is kept",
}


def _how_lost(folder: int, root: Path) -> str | None:
    """What became of the folder that was opened; None where it is still what is found at `root`."""
    opened = os.fstat(folder)
    with contextlib.suppress(OSError):
        if os.path.samestat(opened, os.stat(root)):
            return None
    return "moved" if opened.st_nlink else "removed"
