"""The loops that scenes use, compiled before the first scene, each by one of the processes of a machine that start at once.

Otherwise every process would compile every loop itself when it first uses it. What they share is a file beside the compiled
loops: a byte for each entry of the list, `KEPT` once it is on the disk. Who compiles an entry locks the first one of the same
loop, whose forms for other types lie in the same files.
"""

import fcntl
import gc
import hashlib
import importlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
from numba.core import config
from numba.core.caching import FunctionCache, InTreeCacheLocator
from numba.core.sigutils import normalize_signature

from workers.shard.code import code_digest

LIST = Path(__file__).with_name("loops.txt")
"""A line for each loop and types of its arguments; a loop comes after those that it calls. deploy/compile_loops.py writes it."""

KEPT = b"\1"

_config: Any = config


def compile_together() -> int:
    """Compile what is neither kept nor being compiled by another process; the number of loops that this process took.

    Takes none where all are kept already, beside the code or where this process keeps its own, or where none could be kept.
    """
    entries = LIST.read_text().splitlines()
    name, folders = f"loops-{_digest(entries)}", _folders()
    if not folders or any(_are_kept(folder / name, len(entries)) for folder in folders):
        return 0
    try:
        folders[0].mkdir(parents=True, exist_ok=True)
        shared = os.open(folders[0] / name, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError:
        return 0
    try:
        loops = [entry.split(" ", 2)[:2] for entry in entries]
        with _no_collector():
            taken = sum(
                _take(shared, number, loops.index(loops[number]), entry) for number, entry in enumerate(entries)
            )
    finally:
        os.close(shared)
    for old in folders[0].glob("loops-*"):
        if old.name != name:
            old.unlink(missing_ok=True)
    return taken


def _folders() -> tuple[Path, ...]:
    """Where this process keeps its loops, and beside the code, from where it reads them too; () where it can keep none."""
    try:
        own = FunctionCache(_folders).cache_path
    except RuntimeError:
        return ()
    return Path(own), Path(InTreeCacheLocator(_folders, __file__).get_cache_path())


def _digest(entries: Sequence[str]) -> str:
    """Of all that tells whether a kept loop can be used: the code, numba, and the processor that it compiles for."""
    what = (code_digest(), numba.__version__, str(_config.CPU_NAME), str(_config.CPU_FEATURES), *entries)
    return hashlib.sha256("\n".join(what).encode()).hexdigest()[:16]


def _are_kept(shared: Path, count: int) -> bool:
    try:
        return shared.read_bytes() == count * KEPT
    except OSError:
        return False


@contextmanager
def _no_collector() -> Iterator[None]:
    """Compiling takes 0.83 of the time without Python's collector, and 2 MB more for each loop until it runs again."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
            gc.collect()


def _take(shared: int, number: int, first: int, entry: str) -> bool:
    """Compile one entry unless it is kept, or another process is at its loop: whether this process took it.

    The lock of a process that dies goes with it, and the entry is not kept.
    """
    try:
        fcntl.lockf(shared, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, first)
    except (BlockingIOError, PermissionError):  # what POSIX lets a system say of a lock that another process holds
        return False
    try:
        if os.pread(shared, 1, number) == KEPT:
            return False
        module, name, types = entry.split(" ", 2)
        arguments, _ = normalize_signature(types)  # the types themselves, by which numba keeps a loop
        getattr(importlib.import_module(module), name).compile(arguments)
        os.pwrite(shared, KEPT, number)
        return True
    finally:
        fcntl.lockf(shared, fcntl.LOCK_UN, 1, first)
