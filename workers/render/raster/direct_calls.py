"""OpenGL's functions that are called most, without PyOpenGL's checks of every argument and of every call.

A scene makes 700 calls. PyOpenGL spends 2 to 10 microseconds on each, a plain call takes less than one. An error of a plain
call is raised by the next function that PyOpenGL checks: the read-back of the image at the latest.
"""

import importlib
from ctypes import CFUNCTYPE, c_float, c_int, c_ubyte, c_uint, c_void_p
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
    "glDepthFunc": (c_uint,),
    "glDisable": (c_uint,),
    "glDrawElements": (c_uint, c_int, c_uint, c_void_p),
    "glEnable": (c_uint,),
    "glEnableVertexAttribArray": (c_uint,),
    "glPixelStorei": (c_uint, c_int),
    "glReadBuffer": (c_uint,),
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

_VECTORS, _MATRICES = (c_int, c_int, c_void_p), (c_int, c_int, c_ubyte, c_void_p)


class DirectCalls:
    """The module OpenGL.GL, whose functions in `SIGNATURES`, and uniforms of arrays, are plain calls."""

    def __init__(self, gl: ModuleType) -> None:
        self._gl = gl
        for name, types in SIGNATURES.items():
            setattr(self, name, _plain(name, *types))
        self._uniform_3fv = _plain("glUniform3fv", *_VECTORS)
        self._uniform_3x3 = _plain("glUniformMatrix3fv", *_MATRICES)
        self._uniform_4x4 = _plain("glUniformMatrix4fv", *_MATRICES)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._gl, name)
        setattr(self, name, value)  # found at once the next time
        return value

    def glUniform3fv(self, location: int, count: int, vectors: NDArray[np.float32]) -> None:
        """vectors [count, 3] float32."""
        held = np.ascontiguousarray(vectors, np.float32)
        self._uniform_3fv(location, count, held.ctypes.data)

    def glUniformMatrix3fv(self, location: int, count: int, by_rows: bool, matrix: NDArray[np.float32]) -> None:
        """matrix [3, 3] float32, or `count` of them."""
        held = np.ascontiguousarray(matrix, np.float32)
        self._uniform_3x3(location, count, by_rows, held.ctypes.data)

    def glUniformMatrix4fv(self, location: int, count: int, by_rows: bool, matrix: NDArray[np.float32]) -> None:
        """matrix [4, 4] float32, or `count` of them."""
        held = np.ascontiguousarray(matrix, np.float32)
        self._uniform_4x4(location, count, by_rows, held.ctypes.data)


def _plain(name: str, *types: Any) -> Any:
    """The library's function called `name`, which returns nothing."""
    library = importlib.import_module("OpenGL.platform").PLATFORM.GL
    return CFUNCTYPE(None, *types)((name, library))
