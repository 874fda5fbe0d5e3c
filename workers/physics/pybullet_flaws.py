"""What works around two flaws of PyBullet: it leaks what it is given, and it prints when it is imported."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array

STDERR = 2


@dataclass(frozen=True)
class BulletBuffers:
    """Python objects with new contents for every call.

    PyBullet 3.2.7 takes a reference to each list of vertices or indices and to each item, and never releases it (190
    bytes a vertex).
    """

    points: list[list[float]] = field(default_factory=list)
    integers: list[int] = field(default_factory=list)
    vertex_list: list[list[float]] = field(default_factory=list)
    index_list: list[int] = field(default_factory=list)

    def vertices(self, points: Array) -> list[list[float]]:
        """[N, 3] as lists, valid until the next call."""
        self.points.extend([0.0, 0.0, 0.0] for _ in range(len(points) - len(self.points)))
        for mine, point in zip(self.points, points.tolist(), strict=False):
            mine[:] = point
        self.vertex_list[:] = self.points[: len(points)]
        return self.vertex_list

    def indices(self, values: NDArray[np.integer]) -> list[int]:
        """[N] non-negative integers as a list, valid until the next call."""
        self.integers.extend(range(len(self.integers), int(values.max()) + 1))
        self.index_list[:] = [self.integers[value] for value in values.tolist()]
        return self.index_list


@contextmanager
def silence_stderr() -> Iterator[None]:
    """Discard what C code prints to standard error; an exception is reported after the block, as usual.

    PyBullet prints its build time on import, at the head of every command's messages.
    """
    sys.stderr.flush()
    with open(os.devnull, "wb") as devnull:
        kept = os.dup(STDERR)
        os.dup2(devnull.fileno(), STDERR)
    try:
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
