"""Sorting more than fits in memory: sorted runs on disk, merged as they are read."""

import heapq
import struct
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import IO

_HEAD = struct.Struct("<II")
_OVERHEAD = 150
"""Bytes that Python spends on one pair beside its contents."""


LIMIT_BYTES = 32 << 20
"""Of pairs that wait in memory."""


class ExternalSort:
    """Pairs of bytes, given in any order and read back in order of key, then of value; duplicates stay.

    Memory stays near `limit_bytes` (default LIMIT_BYTES), disk use near the size of all pairs. Who owns `folder` removes it.
    """

    def __init__(self, folder: Path, name: str, limit_bytes: int | None = None) -> None:
        self._folder = folder
        self._name = name
        self._limit = limit_bytes or LIMIT_BYTES
        self._pairs: list[tuple[bytes, bytes]] = []
        self._bytes = 0
        self._runs: list[Path] = []
        self._numbers = count()

    def add(self, key: bytes, value: bytes) -> None:
        """Takes one pair."""
        self._pairs.append((key, value))
        self._bytes += len(key) + len(value) + _OVERHEAD
        if self._bytes > self._limit:
            self._spill()

    def __iter__(self) -> Iterator[tuple[bytes, bytes]]:
        """All pairs in order; may be repeated."""
        self._pairs.sort()
        yield from heapq.merge(self._pairs, *map(_read_run, self._runs))

    def _spill(self) -> None:
        self._pairs.sort()
        self._runs.append(self._write_run(iter(self._pairs)))
        self._pairs, self._bytes = [], 0
        if len(self._runs) >= _MOST_RUNS:
            merged = self._write_run(heapq.merge(*map(_read_run, self._runs)))
            for run in self._runs:
                run.unlink()
            self._runs = [merged]

    def _write_run(self, pairs: Iterator[tuple[bytes, bytes]]) -> Path:
        path = self._folder / f"{self._name}-{next(self._numbers):05d}.run"
        with open(path, "wb") as file:
            for key, value in pairs:
                file.write(_HEAD.pack(len(key), len(value)) + key + value)
        return path


_MOST_RUNS = 64
"""Open files at once."""


def _read_run(path: Path) -> Iterator[tuple[bytes, bytes]]:
    with open(path, "rb", buffering=1 << 16) as file:
        while head := file.read(_HEAD.size):
            key_bytes, value_bytes = _HEAD.unpack(head)
            yield _exactly(file, key_bytes), _exactly(file, value_bytes)


def _exactly(file: IO[bytes], size: int) -> bytes:
    data = file.read(size)
    if len(data) != size:
        raise EOFError(f"a run of the external sort is cut short: {file.name}")
    return data
