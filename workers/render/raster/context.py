"""The OpenGL context, one a process, its functions and its framebuffers.

Of pyrender the EGL platform alone is used, `pyrender.platforms.egl`: it finds a device and makes an off-screen context, on a GPU
or in software, in the way that pyrender's users know; drawing is our own (gbuffer.py says why).

The functions that are called most go without PyOpenGL's checks of every argument and of every call. A scene makes 700 calls.
PyOpenGL spends 2 to 10 microseconds on each, a plain call takes less than one. An error of a plain call is raised by the next
function that PyOpenGL checks: the read-back of the image at the latest.
"""

import importlib
import socket
from collections.abc import Callable, Mapping
from ctypes import CFUNCTYPE, c_void_p
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from schemas.errors import MachineError
from schemas.scene.shape import Appearance
from schemas.scene.view import Intrinsics
from workers.geometry.colour import encode_srgb
from workers.render.raster.devices import NO_GPU, Choice, choose_device, list_devices, load_egl, visible_gpus
from workers.render.raster.draw_calls import Program
from workers.render.raster.lit_shaders import MASK_FRAGMENT, MASK_VERTEX

PLAIN = (
    *("glActiveTexture", "glBindBuffer", "glBindFramebuffer", "glBindTexture", "glBindVertexArray", "glBufferData"),
    *("glClearBufferfv", "glColorMaski", "glDeleteBuffers", "glDeleteTextures", "glDeleteVertexArrays", "glDepthFunc"),
    *("glDisable", "glDrawElements", "glEnable", "glEnableVertexAttribArray", "glPixelStorei", "glReadBuffer"),
    *("glStencilFunc", "glStencilOp", "glTexImage2D", "glUniform1f", "glUniform1i", "glUniform2f", "glUniform3f"),
    *("glUniform3fv", "glUniform4f", "glUniformMatrix3fv", "glUniformMatrix4fv", "glUseProgram"),
    *("glVertexAttribPointer", "glViewport"),
)
"""Functions that return nothing, and take one array, or None, if any. PyOpenGL knows the types of their arguments."""

GENERATORS = ("glGenBuffers", "glGenTextures", "glGenVertexArrays")

ARRAY_TYPES = {"GLfloatArray": np.float32, "GLuintArray": np.uint32}
"""By the name of PyOpenGL's type, that of an array which is always the same; others are passed on as they are."""


class DirectCalls(ModuleType):
    """The module OpenGL.GL, in which the functions above are plain calls."""

    def __init__(self, gl: ModuleType) -> None:
        super().__init__(gl.__name__, gl.__doc__)
        self._gl = gl
        vars(self).update({name: _plain(getattr(gl, name)) for name in PLAIN})
        vars(self).update({name: _generator(getattr(gl, name)) for name in GENERATORS})

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._gl, name)
        setattr(self, name, value)  # found at once the next time
        return value


def _plain(checked: Any) -> Callable[..., None]:
    """The library's function behind one of PyOpenGL's."""
    declared, arrays = getattr(checked, "wrappedOperation", checked), {}
    for place, kind in enumerate(declared.argtypes):
        if kind is c_void_p or kind.__name__ in ARRAY_TYPES:
            arrays[place] = ARRAY_TYPES.get(kind.__name__)
    name, types = declared.__name__, (c_void_p if n in arrays else kind for n, kind in enumerate(declared.argtypes))
    platform, kind = importlib.import_module("OpenGL.platform").PLATFORM, CFUNCTYPE(None, *types)
    try:
        call: Callable[..., None] = kind((name, platform.GL))
    except AttributeError:  # a library need not export what is newer than OpenGL 1.1
        call = kind(platform.getExtensionProcedure(name.encode()))
    if not arrays or name in ("glDrawElements", "glVertexAttribPointer"):  # these take a place in a buffer
        return call
    ((place, dtype),) = arrays.items()

    def with_array(*arguments: Any) -> None:
        if arguments[place] is None:
            call(*arguments)
        else:
            held = np.ascontiguousarray(arguments[place], dtype)
            call(*arguments[:place], held.ctypes.data, *arguments[place + 1 :])

    return with_array


def _generator(checked: Any) -> Callable[[int], NDArray[np.uint32] | int]:
    """The same for a function that makes names: one of them, or an array of several."""
    call = _plain(checked)

    def generate(count: int) -> NDArray[np.uint32] | int:
        names = np.zeros(count, np.uint32)
        call(count, names)
        return names if count > 1 else int(names[0])

    return generate


REMEDY = (
    "rendering needs OpenGL 4.1 through EGL. On Debian or Ubuntu: "
    "apt-get install -y libgl1 libegl1 libgl1-mesa-dri libglu1-mesa. "
    "`verso doctor` says what else is missing"
)

SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software rasterizer", "swr ", "swiftshader", "lavapipe", "basic render")
"""Words of GL_RENDERER, in lower case, where OpenGL runs on the CPU."""


def is_software(name: str) -> bool:
    """Whether a GL_RENDERER is one that draws on the CPU."""
    return any(word in f"{name.lower()} " for word in SOFTWARE)


def require_device(name: str, device: Literal["any", "gpu"], choice: Choice) -> str:
    """What there is to say about the GL_RENDERER called `name`, which was chosen so: nothing where that is as asked.

    Raises MachineError where a GPU is asked for and that is software.
    """
    if not is_software(name):
        return ""
    why, remedy = f": {choice.reason}" if choice.reason else "", choice.remedy or NO_GPU
    if device == "gpu":
        told = f"run.device is gpu, and OpenGL fell back to software on {socket.gethostname()} ({name}){why}"
        raise MachineError(f"{told}: {remedy}, or set run.device: any")
    return f"{socket.gethostname()} draws in software{why}: {remedy}" if why else ""


def choose() -> Choice:
    """The device for this process at this moment. Raises MachineError where EGL has none that it may take."""
    if (visible := visible_gpus()) is None:
        return Choice(0)
    try:
        return choose_device(list_devices(), visible)
    except LookupError as error:
        raise MachineError(f"no OpenGL context could be opened ({error})") from error


def open_context(device: int = 0) -> tuple[ModuleType, Any]:
    """(the functions of OpenGL.GL, pyrender's `EGLPlatform`); a core context of OpenGL 4.1 or later is current afterwards.

    `device`: the place in EGL's list of devices.

    Raises MachineError, with the packages to install, where this machine has no EGL, no OpenGL or too old a one.
    """
    try:
        egl = load_egl()
        platform = egl.EGLPlatform(1, 1, egl.get_device_by_index(device) if device else None)
        platform.init_context()
        gl = importlib.import_module("OpenGL.GL")
        gl.glGetString(gl.GL_RENDERER).decode()
    except Exception as error:  # a missing library shows as ImportError, AttributeError, TypeError, EGLError or assert
        # pyrender takes the first of EGL's devices where none is named.
        found = "EGL has no device" if isinstance(error, IndexError) else f"{type(error).__name__}: {error}"
        raise MachineError(f"no OpenGL context could be opened ({found}): {REMEDY}") from error
    return DirectCalls(gl), platform


def close_context(platform: Any) -> None:
    """Ends a context, and not its display, which other contexts of the process may share: pyrender's own end takes both."""
    egl = importlib.import_module("OpenGL.EGL")
    egl.eglMakeCurrent(platform._egl_display, egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT)
    egl.eglDestroyContext(platform._egl_display, platform._egl_context)
    platform._egl_context = platform._egl_display = None  # what it would end when it is collected


class Framebuffer:
    """Renderbuffers of the size that was bound last: views of one job have the same size."""

    def __init__(self, gl: ModuleType, formats: Mapping[int, int]) -> None:
        """`formats`: OpenGL's internal format of each attachment point."""
        self._gl, self._formats = gl, formats
        self._framebuffer = int(gl.glGenFramebuffers(1))
        self._buffers = [int(name) for name in np.ravel(gl.glGenRenderbuffers(len(formats)))]
        self.size = (0, 0)
        """Width and height, pixels."""

    def bind(self, width: int, height: int) -> None:
        """Draw into, and read from, this framebuffer. Raises RuntimeError where the driver refuses the size."""
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        gl.glViewport(0, 0, width, height)
        if self.size == (width, height):
            return
        for (point, form), buffer in zip(self._formats.items(), self._buffers, strict=True):
            gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
            gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, form, width, height)
            gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, point, gl.GL_RENDERBUFFER, buffer)
        colors = [point for point in self._formats if point in (gl.GL_COLOR_ATTACHMENT0, gl.GL_COLOR_ATTACHMENT1)]
        gl.glDrawBuffers(max(1, len(colors)), colors or [gl.GL_NONE])
        status = int(gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER))
        if status != gl.GL_FRAMEBUFFER_COMPLETE:
            raise RuntimeError(f"a framebuffer of {width} x {height} is not complete: status {status:#x}")
        self.size = (width, height)

    def clear(self, appearance: Appearance, colors: bool = True) -> None:
        """Set every pixel infinitely far away, and without `colors` leave the background and no depth to what is drawn."""
        gl = self._gl
        gl.glClearBufferfv(gl.GL_DEPTH, 0, np.zeros(1, np.float32))  # what the depth test compares falls with distance
        if not colors:
            return
        gl.glClearBufferfv(gl.GL_COLOR, 0, np.append(encode_srgb(np.array(appearance.background)), 0.0))
        if gl.GL_COLOR_ATTACHMENT1 in self._formats:
            gl.glClearBufferfv(gl.GL_COLOR, 1, np.zeros(4, np.float32))

    def read(self, rgba: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Read the first colour attachment into `rgba` [H, W, 4], and return it."""
        gl = self._gl
        gl.glReadBuffer(gl.GL_COLOR_ATTACHMENT0)
        gl.glReadPixels(0, 0, *self.size, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, rgba)
        return rgba


class ColourTarget(Framebuffer):
    """Colour, depth, and a stencil of the pixels to draw: other sample points of edge pixels, textures with holes cut out.

    Hidden fragments and those outside the stencil are dropped before they are shaded.
    """

    def __init__(self, gl: ModuleType) -> None:
        formats = {gl.GL_COLOR_ATTACHMENT0: gl.GL_RGBA8, gl.GL_DEPTH_STENCIL_ATTACHMENT: gl.GL_DEPTH32F_STENCIL8}
        super().__init__(gl, formats)
        self._stencil = Program(gl, MASK_VERTEX, MASK_FRAGMENT)
        self._empty = int(gl.glGenVertexArrays(1))
        self._mask = int(gl.glGenTextures(1))

    def select(self, mask: NDArray[np.uint8], k: Intrinsics) -> None:
        """Bind the framebuffer, and draw only where `mask` [H, W] is not 0, until the stencil test is disabled."""
        gl = self._gl
        self.bind(k.width, k.height)
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._mask)
        gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
        form = (k.width, k.height, 0, gl.GL_RED, gl.GL_UNSIGNED_BYTE, mask)
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, gl.GL_R8, *form)
        for setting in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, setting, gl.GL_NEAREST)
        gl.glClearBufferiv(gl.GL_STENCIL, 0, np.zeros(1, np.int32))
        gl.glEnable(gl.GL_STENCIL_TEST)
        gl.glStencilFunc(gl.GL_ALWAYS, 1, 0xFF)
        gl.glStencilOp(gl.GL_REPLACE, gl.GL_REPLACE, gl.GL_REPLACE)
        gl.glDepthMask(False)
        gl.glDisable(gl.GL_DEPTH_TEST)
        gl.glColorMask(False, False, False, False)
        self._stencil.use()
        gl.glBindVertexArray(self._empty)
        gl.glDrawArrays(gl.GL_TRIANGLES, 0, 3)
        gl.glColorMask(True, True, True, True)
        gl.glEnable(gl.GL_DEPTH_TEST)
        gl.glDepthMask(True)
        gl.glStencilFunc(gl.GL_EQUAL, 1, 0xFF)
        gl.glStencilOp(gl.GL_KEEP, gl.GL_KEEP, gl.GL_KEEP)
