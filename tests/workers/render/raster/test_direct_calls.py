"""Plain calls of OpenGL, without PyOpenGL's checks."""

import ctypes
import importlib

import numpy as np
import pytest

from workers.render.raster import context as direct_calls
from workers.render.raster.context import ARRAYS, GENERATORS, SIGNATURES
from workers.render.raster.draw_calls import Program

VERTEX = "#version 410 core\nuniform mat4 m; void main() { gl_Position = m * vec4(1.0); }"
FRAGMENT = "#version 410 core\nout vec4 o; void main() { o = vec4(1.0); }"


def test_an_error_of_a_plain_call_is_raised_by_the_next_checked_one(renderer):
    gl = renderer._gl
    gl.glEnable(0xFFFF)
    with pytest.raises(gl.GLError, match="1280"):
        gl.glGetFloatv(gl.GL_VIEWPORT)
    assert gl.glGetError() == gl.GL_NO_ERROR


def test_a_function_that_the_library_does_not_export_is_asked_of_egl(renderer, monkeypatch):
    gl, platform = renderer._gl, importlib.import_module("OpenGL.platform").PLATFORM
    monkeypatch.setattr(platform, "GL", ctypes.CDLL(None))
    use = direct_calls._plain("glUseProgram", ctypes.c_uint)
    program = Program(gl, VERTEX, FRAGMENT)
    use(program._name)
    assert gl.glGetIntegerv(gl.GL_CURRENT_PROGRAM) == program._name
    gl.glUseProgram(0)
    gl.glDeleteProgram(program._name)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_matrix_arrives_whatever_its_type_and_order_in_memory(renderer, order, dtype):
    gl, program = renderer._gl, Program(renderer._gl, VERTEX, FRAGMENT)
    program.use()
    matrix = np.arange(16.0).reshape(4, 4).astype(dtype, order=order)
    gl.glUniformMatrix4fv(program._location("m"), 1, True, matrix)
    arrived = np.zeros(16, np.float32)
    gl.glGetUniformfv(program._name, program._location("m"), arrived)
    assert np.array_equal(arrived.reshape(4, 4).T, matrix)
    gl.glDeleteProgram(program._name)


def test_names_are_made_and_deleted(renderer):
    gl = renderer._gl
    one, several = gl.glGenTextures(1), gl.glGenBuffers(2)
    gl.glBindTexture(gl.GL_TEXTURE_2D, one)
    gl.glBindBuffer(gl.GL_ARRAY_BUFFER, several[1])
    assert gl.glIsTexture(one) and gl.glIsBuffer(several[1])
    gl.glDeleteTextures(1, [one])
    gl.glDeleteBuffers(2, several)
    assert not gl.glIsTexture(one) and not gl.glIsBuffer(several[1])


def test_every_plain_call_has_the_arguments_of_the_checked_one(renderer):
    gl = renderer._gl
    for name, types in [*SIGNATURES.items(), *((name, types) for name, (_, types) in ARRAYS.items())]:
        checked = getattr(gl._gl, name)
        while hasattr(checked, "wrappedOperation"):
            checked = checked.wrappedOperation
        assert len(checked.argtypes or types) == len(types), name
    assert all(callable(getattr(gl, name)) for name in GENERATORS)
