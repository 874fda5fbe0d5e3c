"""Compilation by numba of loops that numpy could write only as many passes over memory.

Without `fastmath`, so that sums are added in the order that is written, on every machine.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Loop = TypeVar("Loop", bound=Callable[..., object])


def compiled(loop: Loop) -> Loop:
    """The function compiled at its first call, and kept on disk for the next process where there is a place to write."""
    try:
        return cast(Loop, numba.njit(cache=True, error_model="numpy")(loop))
    except RuntimeError:  # neither the package's folder nor the user's cache is writable
        return cast(Loop, numba.njit(error_model="numpy")(loop))
