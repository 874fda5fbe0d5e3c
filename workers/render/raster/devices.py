"""Edge: the graphics devices that EGL lists, and the one that this process draws on.

Ray tells a worker its GPU in CUDA_VISIBLE_DEVICES. CUDA numbers its GPUs in another order than EGL, whose list also has what
is no NVIDIA GPU, such as Mesa's software. A GPU is known again by its UUID, or by the number that CUDA has for it.
"""

import ctypes
import importlib
import importlib.util
import os
import sys
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

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

    place, extensions = ctypes.cast(handle, ctypes.c_void_p), text(EXTENSIONS).split()
    number, size, raw = ctypes.c_ssize_t(-1), ctypes.c_int(), (ctypes.c_ubyte * 16)()
    ask_number = _function(egl, "eglQueryDeviceAttribEXT", ctypes.c_void_p)
    ask_bytes = _function(egl, "eglQueryDeviceBinaryEXT", ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
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
    return ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_void_p, ctypes.c_int, *types)(address) if address else None
