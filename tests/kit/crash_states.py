"""What a disk may hold after a loss of power: a program's steps are recorded, and every state they allow is made up."""

import builtins
import os
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.kit.faults import Written
from workers.store import file_system, local

Step = tuple[Any, ...]


@dataclass(eq=False)
class File:
    """Bytes now, and those that are on the disk for certain."""

    data: bytes = b""
    flushed: bytes = b""


@dataclass(eq=False)
class Change:
    """One name that a folder gained (`node`) or lost (None). `twin`: the other half of a rename."""

    name: str
    node: "File | Folder | None"
    twin: "tuple[Folder, Change] | None" = None


@dataclass(eq=False)
class Folder:
    """Names now, those on the disk for certain, and the changes that lead from these to those."""

    names: dict[str, "File | Folder"] = field(default_factory=dict)
    flushed: dict[str, "File | Folder"] = field(default_factory=dict)
    pending: list[Change] = field(default_factory=list)
    home: "tuple[Folder, Change] | None" = None
    """The folder that this one is in, and the change that gave it its name there."""

    def change(self, name: str, node: "File | Folder | None") -> Change:
        _apply(self.names, change := Change(name, node))
        self.pending.append(change)
        if isinstance(node, Folder):
            node.home = (self, change)
        return change

    def flush(self) -> None:
        for change in list(self.pending):
            for folder, needed in _needed_by(change):
                folder.pending.remove(needed)
                _apply(folder.flushed, needed)
            _apply(self.flushed, change)
        self.pending = []


def _needed_by(change: Change) -> list[tuple[Folder, Change]]:
    """What is on the disk before a name goes in a rename: the new name, and the names of the folders that lead to it."""
    needed = []
    place = change.twin
    while place is not None:
        folder, arrival = place
        if arrival in folder.pending:
            needed.append(place)
        place = folder.home
    return needed


@dataclass(frozen=True)
class Loss:
    """What a crash leaves of what was not flushed: which changes of names, and which bytes of a file."""

    name: str
    keeps: Callable[[Change], bool]
    bytes_of: Callable[[File], bytes]


def losses(seeds: int) -> list[Loss]:
    """Nothing lost, all, contents alone (emptied, torn), names alone, and `seeds` random mixtures of all these."""
    fixed = [
        Loss("nothing", lambda change: True, lambda file: file.data),
        Loss("everything", lambda change: False, lambda file: file.flushed),
        Loss("contents", lambda change: True, lambda file: file.flushed),
        Loss("halves of contents", lambda change: True, _torn),
        Loss("names", lambda change: False, lambda file: file.data),
    ]
    return fixed + [_mixture(seed) for seed in range(seeds)]


def _mixture(seed: int) -> Loss:
    chance = random.Random(seed)
    kinds = (lambda file: file.data, lambda file: file.flushed, _torn)
    return Loss(f"mixture {seed}", lambda _: chance.random() < 0.5, lambda file: chance.choice(kinds)(file))


def _torn(file: File) -> bytes:
    return file.data if file.data == file.flushed else file.data[: len(file.data) // 2]


class Disk:
    """What the steps so far have made of a folder that held `root` when they began."""

    def __init__(self, root: Path) -> None:
        self.root = _read_tree(root)
        self._open: dict[int, File] = {}

    def play(self, step: Step) -> None:
        kind, *given = step
        getattr(self, f"_{kind}")(*given)

    def after_a_crash(self, loss: Loss) -> dict[str, bytes | None]:
        """Path and bytes of every file that is left, and None for each folder."""
        left: dict[str, bytes | None] = {}

        def visit(folder: Folder, prefix: str) -> None:
            names = dict(folder.flushed)
            for change in self._kept(folder, loss, kept):
                _apply(names, change)
            for name, node in sorted(names.items()):
                if isinstance(node, Folder):
                    left[prefix + name] = None
                    visit(node, f"{prefix}{name}/")
                else:
                    left[prefix + name] = node.data if node.data == node.flushed else loss.bytes_of(node)

        kept: dict[int, bool] = {}
        visit(self.root, "")
        return left

    def _kept(self, folder: Folder, loss: Loss, decided: dict[int, bool]) -> list[Change]:
        def keeps(change: Change) -> bool:
            if id(change) not in decided:
                arrives = change.twin is not None and isinstance(change.twin[1].node, Folder)
                decided[id(change)] = arrives or loss.keeps(change)  # a renamed folder never has two names
                decided[id(change)] &= all(keeps(needed) for _, needed in _needed_by(change))
            return decided[id(change)]

        return [change for change in folder.pending if keeps(change)]

    def _at(self, path: str) -> tuple[Folder, str]:
        *above, name = path.split("/")
        folder = self.root
        for part in above:
            inner = folder.names[part]
            assert isinstance(inner, Folder)
            folder = inner
        return folder, name

    def _file(self, path: str, data: bytes | None = None) -> File:
        """The file at a path; one that something else than the recorded calls wrote is taken as it was seen."""
        folder, name = self._at(path)
        if name not in folder.names:
            folder.change(name, File())
        file = folder.names[name]
        assert isinstance(file, File)
        if data is not None:
            file.data = data
        return file

    def _create(self, handle: int, path: str) -> None:
        self._open[handle] = file = self._file(path)
        file.data = b""

    def _write(self, handle: int, data: bytes) -> None:
        self._open[handle].data += data

    def _mkdir(self, path: str) -> None:
        folder, name = self._at(path)
        folder.change(name, Folder())

    def _link(self, source: str, target: str, data: bytes) -> None:
        folder, name = self._at(target)
        folder.change(name, self._file(source, data))

    def _rename(self, source: str, target: str, data: bytes | None) -> None:
        old, old_name = self._at(source)
        if data is not None:
            self._file(source, data)
        new, new_name = self._at(target)
        arrival = new.change(new_name, old.names[old_name])
        old.change(old_name, None).twin = (new, arrival)

    def _remove(self, path: str) -> None:
        folder, name = self._at(path)
        if name in folder.names:
            folder.change(name, None)

    def _fsync(self, path: str, data: bytes | None) -> None:
        if data is not None:
            file = self._file(path, data)
            file.flushed = file.data
            return
        node: File | Folder = self.root
        for part in path.split("/") if path else ():
            assert isinstance(node, Folder)
            node = node.names[part]
        assert isinstance(node, Folder)
        node.flush()

    def _syncfs(self) -> None:
        folders = [self.root]
        while folders:
            folder = folders.pop()
            folder.flush()
            for node in folder.names.values():
                if isinstance(node, File):
                    node.flushed = node.data
                else:
                    folders.append(node)


def _apply(names: dict[str, File | Folder], change: Change) -> None:
    if change.node is None:
        names.pop(change.name, None)
    else:
        names[change.name] = change.node


def _read_tree(folder: Path) -> Folder:
    tree = Folder()
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.is_dir():
            tree.names[path.name] = _read_tree(path)
        else:
            tree.names[path.name] = File(data := path.read_bytes(), data)
    tree.flushed = dict(tree.names)
    return tree


def write_tree(left: dict[str, bytes | None], root: Path) -> None:
    """Makes a folder of what a crash left."""
    root.mkdir(parents=True)
    for name, data in left.items():
        if data is None:
            (root / name).mkdir()
        else:
            (root / name).write_bytes(data)


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

        def write(data: bytes) -> int:
            for half in (data[: len(data) // 2], data[len(data) // 2 :]):
                steps.append(("write", id(file), bytes(half)))
            return file.write(data)

        return Written(file, write)

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
