"""Recording of a program's steps on the disk, to be played back by `crash_states`."""

import builtins
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.crash_states import Step
from workers.store import file_system, local


@contextmanager
def recorded(root: Path, by_syncfs: bool = True) -> Iterator[list[Step]]:
    """The steps that a program takes below `root` in this context. Nothing is flushed really."""
    steps: list[Step] = []
    inside = os.path.realpath(root)

    def key(path: Any, folder: int | None = None) -> str | None:
        """The path below `root`, None elsewhere."""
        above = os.readlink(f"/proc/self/fd/{folder}") if folder is not None else os.getcwd()
        whole = os.path.join(above, os.fspath(path))
        return os.path.relpath(whole, inside) if whole.startswith(inside + "/") else None

    def seen(path: str) -> bytes | None:
        whole = os.path.join(inside, path)
        return Path(whole).read_bytes() if os.path.isfile(whole) else None

    def two(name: str, real: Callable) -> Callable:
        def call(source: Any, target: Any, **more: Any) -> None:
            old, new = key(source), key(target)
            data = seen(old) if old is not None else None
            real(source, target, **more)
            if old is not None:
                steps.append((name, old, new, data))

        return call

    def one(name: str, real: Callable) -> Callable:
        def call(path: Any, *more: Any, dir_fd: int | None = None) -> None:
            real(path, *more, dir_fd=dir_fd)
            if (found := key(path, dir_fd)) is not None:
                steps.append((name, found))

        return call

    def fsync(descriptor: int) -> None:
        place = os.readlink(f"/proc/self/fd/{descriptor}")
        if place == inside:
            steps.append(("fsync", "", None))
        elif (found := key(place)) is not None and os.path.exists(place):
            steps.append(("fsync", found, seen(found)))

    def opened(path: Any, mode: str = "r", **more: Any) -> Any:
        file = builtins.open(path, mode, **more)  # noqa: SIM115 - the caller's to close
        if mode not in ("wb", "xb") or (found := key(path)) is None:
            return file
        steps.append(("create", id(file), found))
        return _Written(file, lambda half: steps.append(("write", id(file), half)))

    with pytest.MonkeyPatch.context() as patch:
        for name, call in (("link", two("link", os.link)), ("replace", two("rename", os.replace))):
            patch.setattr(os, name, call)
        patch.setattr(os, "rename", two("rename", os.rename))
        patch.setattr(os, "mkdir", one("mkdir", os.mkdir))
        patch.setattr(os, "unlink", one("remove", os.unlink))
        patch.setattr(os, "rmdir", one("remove", os.rmdir))
        patch.setattr(os, "fsync", fsync)
        patch.setattr(local, "open", opened, raising=False)
        patch.setattr(file_system, "_syncfs", lambda descriptor: steps.append(("syncfs",)))
        patch.setattr(file_system, "_trusts_syncfs", lambda folder: by_syncfs)
        yield steps


class _Written:
    """A file whose writes are told."""

    def __init__(self, file: Any, tell: Callable[[bytes], object]) -> None:
        self._file, self._tell = file, tell
        self.close, self.flush, self.fileno = file.close, file.flush, file.fileno

    def write(self, data: bytes) -> int:
        half = len(data) // 2
        self._tell(bytes(data[:half]))
        self._tell(bytes(data[half:]))
        return self._file.write(data)

    def __enter__(self) -> "_Written":
        return self

    def __exit__(self, *raised: object) -> None:
        self._file.close()
