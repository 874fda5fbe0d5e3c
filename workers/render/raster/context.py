"""The OpenGL context, one a process: off-screen, through EGL, opened by pyrender's platform."""

import importlib
import socket
from types import ModuleType
from typing import Any, Literal

from schemas.errors import MachineError
from workers.render.raster.direct_calls import DirectCalls

REMEDY = (
    "rendering needs OpenGL 4.1 through EGL. On Debian or Ubuntu: "
    "apt-get install -y libgl1 libegl1 libgl1-mesa-dri libglu1-mesa. "
    "`verso doctor` says what else is missing"
)

SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software rasterizer", "swr ", "swiftshader", "lavapipe", "basic render")
"""Words of GL_RENDERER, in lower case, where OpenGL runs on the CPU."""

NO_GPU = (
    "install the GPU's driver with its EGL library (NVIDIA: libnvidia-gl; in a container run with --gpus all and "
    "NVIDIA_DRIVER_CAPABILITIES=all) and see that `verso doctor` names the GPU, or set run.device: any"
)


def is_software(name: str) -> bool:
    """Whether a GL_RENDERER is one that draws on the CPU."""
    return any(word in f"{name.lower()} " for word in SOFTWARE)


def require_device(name: str, device: Literal["any", "gpu"]) -> None:
    """Raises MachineError where a GPU is asked for and the GL_RENDERER called `name` is software."""
    if device == "gpu" and is_software(name):
        raise MachineError(
            f"run.device is gpu, and OpenGL fell back to software on {socket.gethostname()} ({name}): {NO_GPU}"
        )


def open_context() -> tuple[ModuleType, Any]:
    """(the functions of OpenGL.GL, pyrender's `EGLPlatform`); a core context of OpenGL 4.1 or later is current afterwards.

    Raises MachineError, with the packages to install, where this machine has no EGL, no OpenGL or too old a one.
    """
    try:
        # pyrender imports pyglet's window, which wants X libraries unless told that there is no display.
        importlib.import_module("pyglet").options["headless"] = True
        platform = importlib.import_module("pyrender.platforms.egl").EGLPlatform(1, 1)
        platform.init_context()
        gl = importlib.import_module("OpenGL.GL")
        gl.glGetString(gl.GL_RENDERER).decode()
    except Exception as error:  # a missing library shows as ImportError, AttributeError, TypeError, EGLError or assert
        # pyrender takes the first of EGL's devices.
        found = "EGL has no device" if isinstance(error, IndexError) else f"{type(error).__name__}: {error}"
        raise MachineError(f"no OpenGL context could be opened ({found}): {REMEDY}") from error
    return DirectCalls(gl), platform
