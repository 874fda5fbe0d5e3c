"""The process's one OpenGL context: off-screen, through EGL, opened with pyrender's platform."""

import importlib
from types import ModuleType
from typing import Any

from schemas.errors import MachineError

REMEDY = (
    "rendering needs OpenGL 4.1 through EGL. On Debian or Ubuntu: "
    "apt-get install -y libgl1 libegl1 libgl1-mesa-dri libglu1-mesa. "
    "`verso doctor` says what else is missing"
)


def open_context() -> tuple[ModuleType, Any]:
    """(the module OpenGL.GL, pyrender's `EGLPlatform`); a core context of OpenGL 4.1 or later is current afterwards.

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
        raise MachineError(f"no OpenGL context could be opened ({type(error).__name__}: {error}): {REMEDY}") from error
    return gl, platform
