"""OpenGL's functions that are called most, without PyOpenGL's checks of every argument and of every call.

A scene makes 700 calls. PyOpenGL spends 2 to 10 microseconds on each, a plain call takes less than one. An error of a plain
call is raised by the next function that PyOpenGL checks: the read-back of the image at the latest.
"""

import importlib
from collections.abc import Callable
from ctypes import CFUNCTYPE, c_float, c_int, c_ssize_t, c_ubyte, c_uint, c_void_p
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

SIGNATURES: dict[str, tuple[Any, ...]] = {
    "glActiveTexture": (c_uint,),
    "glBindBuffer": (c_uint, c_uint),
    "glBindFramebuffer": (c_uint, c_uint),
    "glBindTexture": (c_uint, c_uint),
    "glBindVertexArray": (c_uint,),
    "glColorMaski": (c_uint, c_ubyte, c_ubyte, c_ubyte, c_ubyte),
    "glDepthFunc": (c_uint,),
    "glDisable": (c_uint,),
    "glDrawElements": (c_uint, c_int, c_uint, c_void_p),
    "glEnable": (c_uint,),
    "glEnableVertexAttribArray": (c_uint,),
    "glPixelStorei": (c_uint, c_int),
    "glReadBuffer": (c_uint,),
    "glScissor": (c_int, c_int, c_int, c_int),
    "glStencilFunc": (c_uint, c_int, c_uint),
    "glStencilOp": (c_uint, c_uint, c_uint),
    "glUniform1f": (c_int, c_float),
    "glUniform1i": (c_int, c_int),
    "glUniform2f": (c_int, c_float, c_float),
    "glUniform3f": (c_int, c_float, c_float, c_float),
    "glUniform4f": (c_int, c_float, c_float, c_float, c_float),
    "glUseProgram": (c_uint,),
    "glVertexAttribPointer": (c_uint, c_int, c_uint, c_ubyte, c_int, c_void_p),
    "glViewport": (c_int, c_int, c_int, c_int),
}
"""The types of the arguments of functions that return nothing and take no array."""

ARRAYS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "glBufferData": (None, (c_uint, c_ssize_t, c_void_p, c_uint)),
    "glClearBufferfv": (np.float32, (c_uint, c_int, c_void_p)),
    "glDeleteBuffers": (np.uint32, (c_int, c_void_p)),
    "glDeleteTextures": (np.uint32, (c_int, c_void_p)),
    "glDeleteVertexArrays": (np.uint32, (c_int, c_void_p)),
    "glTexImage2D": (None, (c_uint, c_int, c_int, c_int, c_int, c_int, c_uint, c_uint, c_void_p)),
    "glUniform3fv": (np.float32, (c_int, c_int, c_void_p)),
    "glUniformMatrix3fv": (np.float32, (c_int, c_int, c_ubyte, c_void_p)),
    "glUniformMatrix4fv": (np.float32, (c_int, c_int, c_ubyte, c_void_p)),
}
"""Functions that take an array: its type, where it is always the same, and the types of the arguments."""

GENERATORS = ("glGenBuffers", "glGenTextures", "glGenVertexArrays")


class DirectCalls(ModuleType):
    """The module OpenGL.GL, in which the functions above are plain calls."""

    def __init__(self, gl: ModuleType) -> None:
        super().__init__(gl.__name__, gl.__doc__)
        self._gl = gl
        calls = {name: _plain(name, *types) for name, types in SIGNATURES.items()}
        calls |= {name: _with_array(name, *form) for name, form in ARRAYS.items()}
        calls |= {name: _generator(name) for name in GENERATORS}
        vars(self).update(calls)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._gl, name)
        setattr(self, name, value)  # found at once the next time
        return value


def _plain(name: str, *types: Any) -> Any:
    """The library's function called `name`, which returns nothing."""
    platform, kind = importlib.import_module("OpenGL.platform").PLATFORM, CFUNCTYPE(None, *types)
    try:
        return kind((name, platform.GL))
    except AttributeError:  # a library need not export what is newer than OpenGL 1.1
        return kind(platform.getExtensionProcedure(name.encode()))


def _with_array(name: str, dtype: Any, types: tuple[Any, ...]) -> Callable[..., None]:
    """The same for a function whose only pointer is an array, or None."""
    call, place = _plain(name, *types), types.index(c_void_p)

    def with_array(*arguments: Any) -> None:
        if arguments[place] is None:
            call(*arguments)
        else:
            held = np.ascontiguousarray(arguments[place], dtype)
            call(*arguments[:place], held.ctypes.data, *arguments[place + 1 :])

    return with_array


def _generator(name: str) -> Callable[[int], NDArray[np.uint32] | int]:
    """The same for a function that makes names: one of them, or an array of several."""
    call = _plain(name, c_int, c_void_p)

    def generate(count: int) -> NDArray[np.uint32] | int:
        names = np.zeros(count, np.uint32)
        call(count, names.ctypes.data)
        return names if count > 1 else int(names[0])

    return generate
