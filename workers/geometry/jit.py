"""Compilation by numba of loops that numpy could write only as many passes over memory.

Without `fastmath`, so that sums are added in the order that is written, on every machine.
"""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

import numba
import numpy as np

Loop = TypeVar("Loop", bound=Callable[..., object])


def compiled(loop: Loop) -> Loop:
    """The function compiled at its first call, and kept on disk for the next process where there is a place to write."""
    try:
        dispatcher: Any = numba.njit(cache=True, error_model="numpy")(loop)
    except RuntimeError:  # neither the package's folder nor the user's cache is writable
        return cast(Loop, numba.njit(error_model="numpy")(loop))
    # numba looks for changes in the loop's own file alone, and what the loop uses of other files is compiled into it.
    kept = dispatcher._cache._cache_file
    kept._source_stamp = (kept._source_stamp, *_used_by(loop))
    return cast(Loop, dispatcher)


def _used_by(loop: Callable[..., object]) -> Iterator[tuple[str, Any]]:
    """Name and state of each global that a loop uses: the stamp of another loop, the value of a constant."""
    names: dict[str, Any] = loop.__globals__
    for name in loop.__code__.co_names:
        value = names.get(name)
        other = getattr(getattr(value, "_cache", None), "_cache_file", None)
        if other is not None:
            yield name, other._source_stamp
        elif isinstance(value, np.ndarray):
            yield name, (value.dtype.str, value.shape, value.tobytes())
        elif isinstance(value, bool | int | float | str | tuple | np.generic):
            yield name, repr(value)
