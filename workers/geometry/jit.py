"""Loops over pixels that numpy can only write as many passes over memory, compiled by numba.

Compiled without `fastmath`, so that each sum is the one that is written, in its order, on every machine.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Loop = TypeVar("Loop", bound=Callable[..., object])


def compiled(loop: Loop) -> Loop:
    """The function compiled at its first call, and kept on disk for the next process where there is a place to write."""
    try:
        return cast(Loop, numba.njit(cache=True, error_model="numpy")(loop))
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        return cast(Loop, numba.njit(error_model="numpy")(loop))
