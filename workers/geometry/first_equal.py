"""Equal rows of whole numbers, or of the bits of coordinates."""

import numpy as np
from numpy.typing import NDArray

from workers.geometry.jit import compiled

FRACTION_OF_2_64 = -0x61C8864680B583EB
"""2^64 over the golden ratio, as a signed number: its multiples are spread evenly (Knuth, The Art of Computer Programming
vol. 3, 6.4)."""


def is_first(rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[N]: whether no row before is equal to a row, of rows [N, 3]."""
    return first_equal(rows) == np.arange(len(rows))


@compiled
def first_equal(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """[N]: the first place of a row equal to each of the rows [N, 3]; a row's own where none before it is equal.

    By a hash table: `np.unique` takes forty times as long. Coordinates are given by their bits (`array.view`), among which
    0.0 and -0.0 differ.
    """
    size, shift = 4, 62
    while size < 2 * len(rows):
        size, shift = 2 * size, shift - 1
    slots, first = np.full(size, -1), np.empty(len(rows), np.int64)
    for n in range(len(rows)):
        x, y, z = rows[n, 0], rows[n, 1], rows[n, 2]
        slot = ((x ^ (y >> 21) ^ (y << 43) ^ (z >> 42) ^ (z << 22)) * FRACTION_OF_2_64 >> shift) & (size - 1)
        while slots[slot] >= 0:
            known = slots[slot]
            if rows[known, 0] == x and rows[known, 1] == y and rows[known, 2] == z:
                break
            slot = (slot + 1) & (size - 1)
        if slots[slot] < 0:
            slots[slot] = n
        first[n] = slots[slot]
    return first
