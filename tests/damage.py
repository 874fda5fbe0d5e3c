"""Damage of every kind, at places chosen by a seeded generator over every kind of file of a dataset."""

import random
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

FREE = ("_logs/", "_lock.json", "_staging/")
FEW = 4
"""A kind with at most this many files has every one of them damaged."""

KINDS = (
    (r"manifest/_commits/.*", "commit record"),
    (r"manifest/_ranges/[^/]*/(\w+)\.parquet", "range table"),
    (r"manifest/(\w+)/category=.*", "merged table"),
    (r"assets/.*", "shape"),
    (r".*/patches/.*", "patch"),
    (r"[^/]*/.*\.png", "image"),
    (r"[^/]*/.*\.tar", "archive"),
)


def kind_of(path: str) -> str:
    """The kind of a file; tables by name, and files with one place each by that."""
    for pattern, kind in KINDS:
        if found := re.fullmatch(pattern, path):
            return " ".join([kind, *found.groups()])
    return path


def files_by_kind(root: Path) -> dict[str, list[str]]:
    """Every file of a dataset, by kind."""
    found = defaultdict(list)
    for path in sorted(root.rglob("*")):
        key = path.relative_to(root).as_posix()
        if path.is_file() and not key.startswith(FREE):
            found[kind_of(key)].append(key)
    return dict(found)


def flip(data: bytes, chance: random.Random) -> bytes:
    """One bit is turned."""
    at = chance.randrange(len(data))
    return data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :]


def cut(data: bytes, chance: random.Random) -> bytes:
    """The end is missing; one time in four no byte, or all but one, is left."""
    return data[: chance.choice((0, len(data) - 1, *(chance.randrange(len(data)) for _ in range(6))))]


def remove(data: bytes, chance: random.Random) -> None:
    """The file is missing."""


DAMAGES: tuple[Callable[[bytes, random.Random], bytes | None], ...] = (flip, cut, remove)


def choose_places(root: Path, count: int, seed: int) -> Iterator[tuple[str, str, int]]:
    """(path, kind of damage, seed of the place) so many times.

    Every kind of file has its turn with every kind of damage, and every file of kinds that have few.
    """
    kinds = files_by_kind(root)
    rounds = max(FEW, -(-count // (len(kinds) * len(DAMAGES))))
    chance = random.Random(seed)
    orders = {kind: chance.sample(paths, len(paths)) for kind, paths in kinds.items()}
    places = [
        (orders[kind][turn % len(orders[kind])], damage.__name__, seed * 1_000_003 + turn)
        for turn in range(rounds)
        for damage in DAMAGES
        for kind in kinds
        if turn < len(orders[kind]) or damage is not remove
    ]
    yield from places[:count]


@contextmanager
def damaged(root: Path, path: str, how: str, seed: int) -> Iterator[None]:
    """Within the block one file of a dataset is damaged."""
    file = root / path
    whole = file.read_bytes()
    data = {one.__name__: one for one in DAMAGES}[how](whole, random.Random(seed))
    if data is None or (not whole and how == "flip"):
        file.unlink()
    else:
        file.write_bytes(data)
    try:
        yield
    finally:
        file.write_bytes(whole)
