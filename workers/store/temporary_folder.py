"""A folder on this machine for the files of a step, removed afterwards; those of processes that were killed go with the next."""

import contextlib
import fcntl
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

_LOCK = ".in-use"
_YOUNG_S = 3600.0
"""A folder without its lock file is left alone so long: its process may be just about to make it."""


@contextlib.contextmanager
def temporary_folder(name: str) -> Iterator[Path]:
    """An empty folder. Its owner holds a lock on a file in it, which the kernel gives back when the process ends."""
    remove_abandoned(name)
    with tempfile.TemporaryDirectory(prefix=f"verso-{name}-") as folder, open(Path(folder, _LOCK), "wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        inner = Path(folder, "files")
        inner.mkdir()
        yield inner


def remove_abandoned(name: str) -> None:
    """Removes the folders of this name whose process is gone."""
    for folder in Path(tempfile.gettempdir()).glob(f"verso-{name}-*"):
        with contextlib.suppress(OSError):
            if _is_abandoned(folder):
                shutil.rmtree(folder)


def _is_abandoned(folder: Path) -> bool:
    try:
        with open(folder / _LOCK, "rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
    except BlockingIOError:
        return False
    except FileNotFoundError:
        return time.time() - folder.stat().st_mtime > _YOUNG_S
