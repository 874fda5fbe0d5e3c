"""The graphics devices that EGL lists; the OpenGL context, one a process, its functions and its framebuffers.

Ray tells a worker its GPU in CUDA_VISIBLE_DEVICES. CUDA numbers its GPUs in another order than EGL, whose list also has what
is no NVIDIA GPU, such as Mesa's software. A GPU is known again by its UUID, or by the number that CUDA has for it.

Of pyrender the EGL platform alone is used, `pyrender.platforms.egl`: it finds a device and makes an off-screen context, on a GPU
or in software, in the way that pyrender's users know; drawing is our own (gbuffer.py says why).

The functions that are called most go without PyOpenGL's checks of every argument and of every call. A scene makes 700 calls.
PyOpenGL spends 2 to 10 microseconds on each, a plain call takes less than one. An error of a plain call is raised by the next
function that PyOpenGL checks: the read-back of the image at the latest.
"""

import ctypes
import importlib
import importlib.util
import os
import socket
import sys
import uuid
from collections.abc import Callable, Mapping, Sequence
from ctypes import CFUNCTYPE, c_void_p
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from schemas.errors import MachineError
from schemas.scene.shape import Appearance
from schemas.scene.view import Intrinsics
from workers.geometry.colour import encode_srgb
from workers.render.raster.draw_calls import Program
from workers.render.raster.lit_shaders import MASK_FRAGMENT, MASK_VERTEX

EXTENSIONS, RENDERER, DRM_FILE, CUDA_DEVICE, DEVICE_UUID = 0x3055, 0x335F, 0x3233, 0x323A, 0x335C
"""Names of EGL's queries: EGL_EXTENSIONS, EGL_RENDERER_EXT, EGL_DRM_DEVICE_FILE_EXT, EGL_CUDA_DEVICE_NV, EGL_DEVICE_UUID_EXT."""

VARIABLE = "CUDA_VISIBLE_DEVICES"

NO_GPU = (
    "install the GPU's driver with its EGL library (NVIDIA: libnvidia-gl; in a container run with --gpus all and "
    "NVIDIA_DRIVER_CAPABILITIES=all) and see that `verso doctor` names the GPU"
)


@dataclass(frozen=True)
class GraphicsDevice:
    """A device of EGL's list."""

    index: int
    """Its place there."""
    name: str
    is_nvidia: bool = False
    cuda: int | None = None
    """The number that CUDA has for it; None where it tells none."""
    uuid: str = ""
    """GPU-..., as `nvidia-smi -L` writes it; empty where the driver does not tell it."""


@dataclass(frozen=True)
class Choice:
    """The device to draw on; `reason` tells why it is not the GPU that was named, and `remedy` what to do."""

    index: int
    reason: str = ""
    remedy: str = ""


def choose_device(devices: Sequence[GraphicsDevice], visible: str | None) -> Choice:
    """The device that CUDA_VISIBLE_DEVICES names first; EGL's first one where it names none.

    Ray empties it for a task that asks for no part of a GPU, which hides nothing from OpenGL. Where EGL lacks what is named, the
    first one that is no NVIDIA GPU, since others may have those. Raises LookupError where there is none.
    """
    if not visible:
        return Choice(0)
    gpus = [device for device in devices if device.is_nvidia]
    named = visible.split(",")[0].strip()
    found = _find(gpus, named)
    if found is not None:
        return Choice(found.index)
    told = f"{VARIABLE} is {visible!r}"
    if named.upper().startswith("MIG-"):
        reason = f"{told}, a part of a GPU in MIG mode, in which OpenGL does not draw"
        remedy = "give the run whole GPUs (`nvidia-smi -mig 0`)"
    elif named == "-1":
        reason, remedy = (f"{told}, which hides every GPU", "unset it") if gpus else ("", "")
    else:
        has = ", ".join(describe(device) for device in gpus) or "no NVIDIA GPU"
        reason, remedy = f"{told}, and EGL has {has}", NO_GPU
    other = next((device.index for device in devices if not device.is_nvidia), None)
    if other is None and devices:
        raise LookupError(f"{reason}: {remedy}")
    return Choice(other or 0, reason, remedy)


def _find(gpus: Sequence[GraphicsDevice], named: str) -> GraphicsDevice | None:
    """The GPU of this number, or whose UUID begins so; None where there is none, or several."""
    if named.startswith("GPU-"):
        same = [gpu for gpu in gpus if gpu.uuid.startswith(named.lower().replace("gpu-", "GPU-"))]
        return same[0] if len(same) == 1 else None
    if not named.isdecimal():
        return None
    numbered = {gpu.cuda: gpu for gpu in gpus if gpu.cuda is not None}
    if len(numbered) < len(gpus) and len(numbered) == 1:
        return numbered.get(0)  # CUDA numbers what is visible alone, and nothing else has a number
    return numbered.get(int(named))


def describe(device: GraphicsDevice) -> str:
    """A device in a few words."""
    facts = [device.name, *([f"CUDA {device.cuda}"] if device.cuda is not None else []), device.uuid]
    return f"EGL device {device.index} ({', '.join(fact for fact in facts if fact)})"


def visible_gpus() -> str | None:
    """CUDA_VISIBLE_DEVICES as it is now: Ray sets it anew for each task of a process."""
    return os.environ.get(VARIABLE)  # noqa: TID251 - how Ray tells a task its GPU


def load_egl() -> ModuleType:
    """The module `pyrender.platforms.egl`, without the package, which imports pyglet, trimesh and more: 0.5 s a process."""
    package = importlib.util.find_spec("pyrender")
    if package is None or "pyrender" in sys.modules:
        return importlib.import_module("pyrender.platforms.egl")
    sys.modules["pyrender"] = importlib.util.module_from_spec(package)  # stands for the package, which is not run
    try:
        return importlib.import_module("pyrender.platforms.egl")
    finally:
        del sys.modules["pyrender"]


@cache
def list_devices() -> tuple[GraphicsDevice, ...]:
    """EGL's devices in its order; none where EGL cannot list them."""
    egl = load_egl()
    if egl._eglQueryDevicesEXT is None:
        return ()
    return tuple(_look_at(egl, index, device._display) for index, device in enumerate(egl.query_devices()))


def _look_at(egl: ModuleType, index: int, handle: Any) -> GraphicsDevice:
    """A device, with what its driver tells of it."""

    def text(name: int) -> str:
        told: bytes | None = egl._eglQueryDeviceStringEXT(handle, name)
        return told.decode("utf-8", "replace") if told else ""

    place, extensions = ctypes.cast(handle, c_void_p), text(EXTENSIONS).split()
    number, size, raw = ctypes.c_ssize_t(-1), ctypes.c_int(), (ctypes.c_ubyte * 16)()
    ask_number = _function(egl, "eglQueryDeviceAttribEXT", c_void_p)
    ask_bytes = _function(egl, "eglQueryDeviceBinaryEXT", ctypes.c_int, c_void_p, c_void_p)
    is_nvidia = "EGL_NV_device_cuda" in extensions
    has_number = is_nvidia and ask_number and ask_number(place, CUDA_DEVICE, ctypes.byref(number))
    has_uuid = "EGL_EXT_device_persistent_id" in extensions and ask_bytes
    has_uuid = has_uuid and ask_bytes(place, DEVICE_UUID, 16, raw, ctypes.byref(size)) and size.value == 16
    name = (text(RENDERER) if "EGL_EXT_device_query_name" in extensions else "") or (
        "Mesa's software" if "EGL_MESA_device_software" in extensions else text(DRM_FILE) or "unnamed"
    )
    known_as = f"GPU-{uuid.UUID(bytes=bytes(raw))}" if has_uuid else ""
    return GraphicsDevice(index, name, is_nvidia, int(number.value) if has_number else None, known_as)


def _function(egl: ModuleType, name: str, *types: Any) -> Any:
    """A function of EGL that takes a device, the name of a query and further arguments; None where EGL has none."""
    address = egl.egl.eglGetProcAddress(name)
    return CFUNCTYPE(ctypes.c_uint, c_void_p, ctypes.c_int, *types)(address) if address else None


def choose() -> Choice:
    """The device for this process at this moment. Raises MachineError where EGL has none that it may take."""
    if (visible := visible_gpus()) is None:
        return Choice(0)
    try:
        return choose_device(list_devices(), visible)
    except LookupError as error:
        raise MachineError(f"no OpenGL context could be opened ({error})") from error


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
