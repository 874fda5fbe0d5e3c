"""The folder of a private Ray: closed to other users, short enough for its sockets, removed once its owner is gone."""

import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from schemas.errors import MachineError

PREFIX = "vr-"

OWNER = "owner"
"""A file that the owner keeps locked. The kernel unlocks it when the process ends, however that happens."""

INNER = "r"
"""What Ray gets. It opens its own folder to every user (0777), so it gets one inside a folder that nobody else enters."""

SOCKET_BYTES = 107
"""The longest name of a Unix socket on Linux."""

SESSION_BYTES = len("/session_2026-01-01_00-00-00_000000_4194304/sockets/plasma_store")
"""What Ray puts behind the name of its folder; 4194304 is the largest process id."""

MAX_BASE_BYTES = SOCKET_BYTES - SESSION_BYTES - len(f"/{PREFIX}12345678/{INNER}")
"""The longest temporary folder that has room for a private Ray's."""

OTHERS = (Path("/tmp"), Path("/var/tmp"), Path("/dev/shm"))
"""Where to go when the user's temporary folder has too long a name."""


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """An empty folder that no other user can enter; removed when the block ends.

    Folders of processes that are gone are removed first. Raises MachineError where no place has a name short enough.
    """
    places = _places()
    for place in places:
        remove_dead(place)
    folder, owner = _make(places)
    try:
        yield folder / INNER
    finally:
        _remove(folder)
        os.close(owner)


def remove_dead(place: Path) -> None:
    """Removes this user's folders below `place` whose owner does not live."""
    for folder in place.glob(f"{PREFIX}*"):
        # Locked by a process that lives, or not one of these folders, or removed by another process meanwhile.
        with contextlib.suppress(OSError):
            _remove_if_dead(folder)


def _places() -> list[Path]:
    """The user's temporary folder if its name is short enough, then the others. Raises MachineError if none exists."""
    try:
        wanted = Path(tempfile.gettempdir())
    except FileNotFoundError as error:
        raise MachineError(f"{error.strerror}: set TMPDIR to one that can be written") from error
    places = [place for place in (wanted, *OTHERS) if len(os.fsencode(place)) <= MAX_BASE_BYTES]
    return list(dict.fromkeys(places))


def _make(places: Sequence[Path]) -> tuple[Path, int]:
    """A folder in the first place that takes one, and the open file that shows that its owner lives."""
    errors = []
    for place in places:
        try:
            folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=place))
            (folder / INNER).mkdir()
            return folder, _lock(folder)
        except OSError as error:
            errors.append(f"{place} ({error.strerror or error})")
    wanted = tempfile.gettempdir()
    tried = f"; cannot be written: {', '.join(errors)}" if errors else ""
    raise MachineError(
        f"no place for Ray's sockets: the name of {wanted} has {len(os.fsencode(wanted))} bytes, at most {MAX_BASE_BYTES} "
        f"fit{tried}: set TMPDIR to a writable folder with a short name"
    )


def _lock(folder: Path) -> int:
    """Locks the owner's file. It gets its name when it is locked, so that nobody ever finds it unlocked before."""
    unnamed = folder / f"{OWNER}.new"
    file = os.open(unnamed, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    unnamed.rename(folder / OWNER)
    return file


def _remove_if_dead(folder: Path) -> None:
    """Raises OSError where the owner lives, or where the folder is none of this user's."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
        return
    file = os.open(folder / OWNER, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove(folder)
    finally:
        os.close(file)


def _remove(folder: Path) -> None:
    """Removes a folder, the owner's file last: what a process that is just ending wrote meanwhile is found again."""
    shutil.rmtree(folder / INNER, ignore_errors=True)
    if not (folder / INNER).exists():
        shutil.rmtree(folder, ignore_errors=True)
