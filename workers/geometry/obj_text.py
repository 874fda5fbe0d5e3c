"""Convex parts as the text of an OBJ file. Pure."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled

DECIMALS = 8
"""Decimals that coordinates are rounded to, metres."""

MOST_LETTERS = 16
"""Letters that a coordinate takes at most, with the space before it."""


def obj_of(parts: Sequence[Array]) -> bytes:
    """An object `part0`, `part1` ... for each part [N, 3], of which a reader wants the vertices: its faces are a fan over all.

    Coordinates are rounded to `DECIMALS` already. They have nine significant digits, those that float32 keeps: `%.9g`.
    """
    texts = (b"o part%d\n" % n + _vertices_of(part) + _fan_over(len(part)) for n, part in enumerate(parts))
    return b"".join(texts)


def _vertices_of(part: Array) -> bytes:
    """A line `v x y z` for each of the points [N, 3]."""
    letters = np.empty(len(part) * (3 * MOST_LETTERS + 2), np.uint8)
    length = _write_vertices(np.ascontiguousarray(part), letters)
    if length < 0:
        return ("v %.9g %.9g %.9g\n" * len(part) % tuple(part.ravel().tolist())).encode("ascii")
    return letters[:length].tobytes()


@lru_cache(1024)
def _fan_over(count: int) -> bytes:
    """The faces over so many vertices, counted from the last vertex back, as OBJ allows, in any part alike."""
    return b"".join(b"f %d %d %d\n" % (-count, k - count, k - count + 1) for k in range(1, count - 1))


@compiled
def _write_vertices(points: Array, text: NDArray[np.uint8]) -> int:
    """Writes the lines of points [N, 3] into `text`, ASCII, and returns their length; -1 for points 10 metres away.

    Python's own formatting takes five times as long.
    """
    at = 0
    for point in points:
        text[at] = ord("v")
        at += 1
        for value in point:
            if not abs(value) < 10.0:
                return -1
            text[at] = ord(" ")
            at = _write_number(value, text, at + 1)
        text[at] = ord("\n")
        at += 1
    return at


@compiled
def _write_number(value: float, text: NDArray[np.uint8], at: int) -> int:
    """Writes a number as `%.9g` has it to `text` from `at` on, and returns where it ends."""
    digits = np.int64(np.rint(abs(value) * 10.0**DECIMALS))
    if np.signbit(value):
        text[at] = ord("-")
        at += 1
    before, power = DECIMALS, 0  # the digits after the point, and the exponent
    if 0 < digits < 10 ** (DECIMALS - 4):  # below a ten-thousandth: one digit, the point, the others, an exponent
        before = int(digits >= 10) + int(digits >= 100) + int(digits >= 1000)
        power = DECIMALS - before
    scale = 10**before
    text[at] = ord("0") + digits // scale
    at, digits = at + 1, digits % scale
    if digits > 0:
        text[at] = ord(".")
        at += 1
    while digits > 0:
        scale //= 10
        text[at] = ord("0") + digits // scale
        at, digits = at + 1, digits % scale
    if power > 0:
        text[at], text[at + 1], text[at + 2], text[at + 3] = ord("e"), ord("-"), ord("0"), ord("0") + power
        at += 4
    return at
