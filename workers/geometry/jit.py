"""Compilation by numba of loops that numpy could write only as many passes over memory.

Without `fastmath`, so that sums are added in the order that is written, on every machine.
"""

import contextlib
from collections.abc import Callable, Iterator
from types import CodeType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.caching import FunctionCache, IndexDataCacheFile, InTreeCacheLocator

Loop = TypeVar("Loop", bound=Callable[..., object])

_njit: Any = numba.njit
"""Its types lack `no_cfunc_wrapper`. What C code would call by a pointer, which none does, is a tenth of compiling."""


def compiled(loop: Loop) -> Loop:
    """The function compiled at its first call, and kept on disk for the next process where there is a place to write."""
    dispatcher: Any = _njit(error_model="numpy", no_cfunc_wrapper=True)(loop)
    with contextlib.suppress(RuntimeError):  # where neither the package's folder nor the user's cache is writable
        dispatcher._cache = _LoopCache(loop)
    return cast(Loop, dispatcher)


def used_by(loop: Callable[..., object]) -> dict[tuple[str, str], object]:
    """A loop and all that it uses, by module and name: of loops what they compute, of constants the value."""
    used: dict[tuple[str, str], object] = {}
    _find_used(loop, used)
    return used


class _LoopFile(IndexDataCacheFile):
    """The kept forms of one loop, each with what it was compiled from.

    Of two processes that keep forms of one loop at the same moment, numba may file the one's code under the other's types.
    """

    def save(self, key: object, data: object) -> None:
        """Keep the form that was compiled for a key."""
        super().save(key, (self._source_stamp, key, data))

    def load(self, key: object) -> object:
        """The form that was compiled for the key, of the loop as it is now; None where it is not kept."""
        kept: Any = super().load(key)
        return kept[2] if kept is not None and kept[:2] == (self._source_stamp, key) else None


class _LoopCache(FunctionCache):
    """A loop on disk, as long as what it uses stays the same.

    numba looks for changes in the loop's own file alone, and what the loop uses of other files is compiled into it. A loop
    that is not where this process keeps its loops may lie beside the loop's file, as the image has them, which is then read.
    """

    def __init__(self, loop: Callable[..., object]) -> None:
        super().__init__(loop)
        self._own_stamp = self._cache_file._source_stamp
        beside = InTreeCacheLocator(loop, loop.__code__.co_filename).get_cache_path()
        own, other = (_LoopFile(path, self._impl.filename_base, self._own_stamp) for path in (self._cache_path, beside))
        self._cache_file, self._files = own, (own, other)

    def _load_overload(self, signature: object, target_context: Any) -> object:
        """Reads the loop, at its first call, when all that it uses is defined; saving comes after. None where it is not kept."""
        used = used_by(self._py_func)
        key = self._index_key(signature, target_context.codegen())
        for file in self._files:
            file._source_stamp = self._own_stamp, used
            with contextlib.suppress(OSError):
                if (kept := file.load(key)) is not None:
                    return self._impl.rebuild(target_context, kept)
        return None


def _find_used(loop: Callable[..., object], used: dict[tuple[str, str], object]) -> None:
    """Adds a loop and all that it uses to what was found before."""
    codes = list(_codes_in(loop.__code__))
    constants = [[value for value in code.co_consts if not isinstance(value, CodeType)] for code in codes]
    used[loop.__module__, loop.__qualname__] = [(code.co_code, code.co_names) for code in codes], repr(constants)
    for name in (name for code in codes for name in code.co_names):
        value, key = loop.__globals__.get(name), (loop.__module__, name)
        other = getattr(value, "py_func", None)
        if other is not None and (other.__module__, other.__qualname__) not in used:
            _find_used(other, used)
        elif isinstance(value, np.ndarray):
            used[key] = value.dtype.str, value.shape, value.tobytes()
        elif isinstance(value, bool | int | float | str | tuple | np.generic):
            used[key] = repr(value)


def _codes_in(code: CodeType) -> Iterator[CodeType]:
    """The code of a function and of its comprehensions."""
    yield code
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _codes_in(inner)
