"""Calls to a local file system: its type, flushing to the disk, a probe, temporary files and folders, errors explained."""

import contextlib
import ctypes
import errno
import fcntl
import hashlib
import os
import pwd
import re
import shutil
import stat
import tempfile
import uuid
import weakref
from collections.abc import Iterable, Iterator
from io import BufferedIOBase
from pathlib import Path
from typing import IO

from schemas.dataset.layout import COMMITS, PROBE_PREFIX, TEMPORARY
from schemas.errors import MachineError, OutputError

_SYNCFS_TYPES = frozenset({"ext2", "ext3", "ext4", "xfs", "btrfs", "f2fs", "zfs", "tmpfs", "overlay"})
"""File systems whose syncfs(2) is known to write everything back; others (FUSE among them) may do nothing in it."""

_SYNCFS_REPORTS_ERRORS = (5, 8)
"""The first Linux whose syncfs(2) reports a failed write."""

_FEW_FOLDERS = 3
"""Up to this many folders are flushed one by one; for more, one syncfs is less work where it can be trusted."""

_REMEDIES = {
    errno.ENOSPC: "the disk is full; free some space and start again, nothing finished is lost",
    errno.EDQUOT: "the disk quota is used up; free some space and start again, nothing finished is lost",
    errno.EFBIG: "a file may not grow beyond the limit of this shell (ulimit -f); raise it and start again",
    errno.EMFILE: "this process may not open more files; raise `ulimit -n` and start again",
    errno.EROFS: "the file system is mounted read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EIO: "the disk reports an input/output error; check it before going on",
}


def file_system_of(folder: str | Path) -> str:
    """The type (`ext4`, `nfs4` ...) of the file system that holds `folder`, `unknown` where Linux does not say."""
    try:
        lines = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return "unknown"
    place = Path(os.path.realpath(folder))
    best, kind = "", "unknown"
    for line in lines:
        fields, _, rest = line.partition(" - ")
        mount = re.sub(r"\\(\d{3})", lambda octal: chr(int(octal[1], 8)), fields.split()[4])
        if place.is_relative_to(mount) and len(mount) >= len(best):
            best, kind = mount, rest.split()[0]
    return kind


class OpenTree:
    """A folder that is kept open from before its first file is written until all of them are on the disk.

    The kernel tells of a failed write once for each descriptor that was open then. So, where syncfs cannot be trusted,
    each file must be flushed before it is closed (`flush_file`).
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._by_syncfs = _trusts_syncfs(folder)
        self._descriptor = os.open(folder, os.O_RDONLY)
        self.close = weakref.finalize(self, os.close, self._descriptor)
        """Closes the descriptor; also called when nobody uses the object any more."""

    def flush_file(self, file: IO[bytes]) -> None:
        """Flushes one finished file, unless one syncfs does so for all in the end."""
        if not self._by_syncfs:
            file.flush()
            os.fsync(file.fileno())

    def flush(self, root: Path) -> None:
        """Returns when every file and folder below, and the names that lead there from `root`, are on the disk.

        Raises OSError where a write to this file system has failed since the folder was opened.
        """
        if self._by_syncfs:
            _syncfs(self._descriptor)
        else:
            for folder in [*(path for path in self._folder.rglob("*") if path.is_dir()), self._folder]:
                sync_path(folder)
            for folder in self._folder.relative_to(root).parents:
                sync_path(root / folder)


def refuse_link_out(root: str | Path, key: str) -> None:
    """Raises OutputError where a folder on the way to `key`, or `key` itself, is a symbolic link that leads out of `root`.

    So a folder from somebody else cannot make this program write or remove elsewhere.
    """
    base = os.fspath(root)
    for end in [*(at for at, letter in enumerate(key) if letter == "/"), len(key)]:
        place = f"{base}/{key[:end]}"
        if os.path.islink(place) and not Path(os.path.realpath(place)).is_relative_to(os.path.realpath(base)):
            raise OutputError(
                f"{place} is a symbolic link that leads out of {base}, to {os.path.realpath(place)}: nothing is written "
                "through it; put a folder in its place, or choose another --out"
            )


def sync_folders(root: Path, folders: Iterable[str]) -> None:
    """Returns when the names in `folders`, paths below `root`, are on the disk; deeper ones first."""
    ordered = sorted(folders, reverse=True)
    if len(ordered) > _FEW_FOLDERS and _trusts_syncfs(root):
        with _descriptor(root) as descriptor:
            _syncfs(descriptor)
    else:
        for folder in ordered:
            sync_path(root / folder)


def sync_path(path: str | Path) -> None:
    """Returns when a file's bytes, or the names in a folder, are on the disk."""
    with _descriptor(path) as descriptor:
        os.fsync(descriptor)


def _syncfs(descriptor: int) -> None:
    """Writes back the whole file system of `descriptor`. Raises OSError where writing failed since it was opened."""
    if ctypes.CDLL(None, use_errno=True).syncfs(descriptor) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def sha256_of(file: IO[bytes] | BufferedIOBase) -> str:
    """The digest of a file from where it stands; Python 3.10 has no `hashlib.file_digest`."""
    digest = hashlib.sha256()
    while block := file.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()


@contextlib.contextmanager
def _descriptor(path: str | Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _trusts_syncfs(folder: Path) -> bool:
    kernel = tuple(int(part) for part in os.uname().release.split("-")[0].split(".")[:2])
    return kernel >= _SYNCFS_REPORTS_ERRORS and file_system_of(folder) in _SYNCFS_TYPES


def probe_folder(root: Path) -> None:
    """Returns where linking refuses a second name, renaming replaces and syncing works under `root`.

    Raises OutputError naming the step that failed, the type of the file system and a remedy, FileNotFoundError where the
    probe was swept.
    """
    name = f"{PROBE_PREFIX}{uuid.uuid4().hex}"
    source, target = root / TEMPORARY / name, root / COMMITS / name
    step = "writing a file"
    try:
        source.write_bytes(b"probe")
        step = "fsync"
        sync_path(source)
        step = "a hard link"
        os.link(source, target)
        sync_path(target.parent)
        step = "refusing a second hard link to one name"
        with contextlib.suppress(FileExistsError):
            os.link(source, target)
            raise OSError("a second link was accepted")
        step = "rename"
        os.unlink(target)
        os.replace(source, target)
        if source.exists() or target.read_bytes() != b"probe":
            raise OSError("the renamed file reads back differently")
    except FileNotFoundError:
        raise
    except OSError as error:
        if error.errno in _REMEDIES and (step == "writing a file" or error.errno != errno.EPERM):
            raise cannot_be_written(root, error) from error
        raise OutputError(
            f"{root} is on a file system of type {file_system_of(root)} that fails at {step} "
            f"({error.strerror or error}): commits there would not be safe. "
            "Choose an --out on a local disk (ext4, xfs, btrfs) or NFS"
        ) from error
    finally:
        for path in (source, target):
            with contextlib.suppress(OSError):
                os.unlink(path)


def cannot_be_written(place: object, error: OSError) -> OutputError:
    """The error for an output folder that is refused."""
    why = remedy_of(error) or error.strerror or error
    return OutputError(f"{place} cannot be written: {why}; or choose another --out")


def ignore_missing(function: object, path: str, raised: tuple[type[BaseException], BaseException, object]) -> None:
    """For `shutil.rmtree`: what is gone already need not be removed."""
    if not isinstance(raised[1], FileNotFoundError):
        raise raised[1]


@contextlib.contextmanager
def temporary_file(folder: Path, data: bytes, durable: bool, name: str | None = None) -> Iterator[Path]:
    """A finished file in `folder`, gone when the context ends; by default of a name that no other has.

    Raises FileNotFoundError where there is no folder.
    """
    temporary = folder / (name or f".{uuid.uuid4().hex}")
    try:
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        yield temporary
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)


def remedy_of(error: OSError) -> str | None:
    """What a user can do about it, where something can be done; says which user has no permission."""
    remedy = _REMEDIES.get(error.errno or 0)
    if error.errno not in (errno.EACCES, errno.EPERM):
        return remedy
    user = str(os.geteuid())
    with contextlib.suppress(KeyError):  # a container's user often has no name
        user = f"{pwd.getpwuid(os.geteuid()).pw_name} ({user})"
    return f"{remedy} for user {user}: have its owner allow it"


@contextlib.contextmanager
def explain_disk_errors(what: str) -> Iterator[None]:
    """Turns an OSError that a user can mend into a MachineError: `what` happened, why, and what to do."""
    try:
        yield
    except OSError as error:
        if error.errno in _REMEDIES:
            raise MachineError(f"{what}: {remedy_of(error)}") from error
        raise


OWNER, _FREE = ".in-use", ".made"
"""Names of the file that the owner of a temporary folder keeps locked: held, and before it is."""

INNER = "r"
"""The folder inside that is used. Ray opens its own to every user (0777), and sockets need short names."""


@contextlib.contextmanager
def temporary_folder(name: str) -> Iterator[Path]:
    """An empty folder of this machine, after those of this name whose process is gone were removed."""
    place, prefix = Path(tempfile.gettempdir()), f"verso-{name}-"
    owned_folders(place, prefix)
    with owned_folder(place, prefix) as folder:
        yield folder


@contextlib.contextmanager
def owned_folder(place: Path, prefix: str) -> Iterator[Path]:
    """An empty folder inside a new one of `place`, which no other user can enter; both are removed when the block ends.

    The owner holds a lock on a file there, which the kernel gives back when the process ends, however that happens. Raises
    OSError where none can be made.
    """
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
    try:
        (folder / INNER).mkdir()
        with open(folder / _FREE, "wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            os.rename(folder / _FREE, folder / OWNER)  # once it is held: whoever finds it free removes the folder
            yield folder / INNER
    finally:
        _remove_owned(folder)


def owned_folders(place: Path, prefix: str) -> list[Path]:
    """This user's folders in `place` whose owners live. Those whose process is gone are removed.

    One that was killed before it made its lock file is neither.
    """
    owned = []
    for folder in place.glob(f"{prefix}*"):
        with contextlib.suppress(OSError):  # not one of these folders, or removed by another process meanwhile
            status = folder.lstat()
            if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
                continue
            with open(os.open(folder / OWNER, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)) as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    owned.append(folder)
                else:
                    _remove_owned(folder)
    return owned


def _remove_owned(folder: Path) -> None:
    """Removes a folder, the owner's file last: what a process that is just ending wrote meanwhile is found again."""
    shutil.rmtree(folder / INNER, ignore_errors=True)
    if not (folder / INNER).exists():
        shutil.rmtree(folder, ignore_errors=True)
