"""Which of EGL's devices a process draws on, for what Ray and users put into CUDA_VISIBLE_DEVICES."""

import ctypes
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from schemas.errors import MachineError
from workers.render.raster import context, gbuffer
from workers.render.raster.context import Choice, GraphicsDevice, choose_device, describe, require_device

FIRST, SECOND = "GPU-11111111-aaaa-bbbb-cccc-000000000001", "GPU-22222222-aaaa-bbbb-cccc-000000000002"
SOFTWARE = GraphicsDevice(1, "Mesa's software")
ALONE = replace(SOFTWARE, index=0)
GPUS = [GraphicsDevice(0, "H100", True, 1, SECOND), SOFTWARE, GraphicsDevice(2, "H100", True, 0, FIRST)]
"""EGL lists them in another order than CUDA, and software between them."""
RENUMBERED = [replace(GPUS[0], cuda=0), SOFTWARE, replace(GPUS[2], cuda=None)]
"""As a driver may tell it while one GPU alone is visible to CUDA."""


def test_a_gpu_is_found_by_number_and_by_uuid_wherever_egl_lists_it():
    for listed, visible, index in [
        (GPUS, None, 0),
        ([ALONE], None, 0),
        ([], None, 0),
        (GPUS, "", 0),
        (GPUS, "0", 2),
        (GPUS, "1", 0),
        (GPUS, " 1,0", 0),
        (GPUS, FIRST, 2),
        (GPUS, "GPU-2222", 0),
        (GPUS, FIRST.upper(), 2),
        (RENUMBERED, "1", 0),
        ([ALONE], "", 0),
        ([ALONE], "-1", 0),
    ]:
        assert choose_device(listed, visible) == Choice(index), (visible, listed)


REFUSED = [
    (GPUS, "-1", "which hides every GPU", "unset it"),
    (GPUS, "3", f"'3', and EGL has EGL device 0 (H100, CUDA 1, {SECOND})", "NVIDIA_DRIVER_CAPABILITIES=all"),
    (GPUS, "GPU-3", "and EGL has EGL device 0", "--gpus all"),
    (GPUS, "GPU-", "and EGL has EGL device 0", "--gpus all"),  # begins every one of them
    (GPUS, "NoDevFiles", "'NoDevFiles', and EGL has", "--gpus all"),
    ([ALONE], "0", "'0', and EGL has no NVIDIA GPU", "NVIDIA_DRIVER_CAPABILITIES=all"),
    ([], "0", "'0', and EGL has no NVIDIA GPU", "NVIDIA_DRIVER_CAPABILITIES=all"),
    (GPUS, "MIG-5c8e0f7e-1111-2222-3333-444444444444", "in MIG mode", "nvidia-smi -mig 0"),
    (GPUS, f"MIG-{FIRST}/1/0", "in MIG mode", "nvidia-smi -mig 0"),
]


@pytest.mark.parametrize(("listed", "visible", "reason", "remedy"), REFUSED)
def test_a_gpu_that_egl_lacks_is_told_with_its_name_and_never_another_one_taken(listed, visible, reason, remedy):
    choice = choose_device(listed, visible)
    assert choice.index == (1 if listed is GPUS else 0)
    assert f"CUDA_VISIBLE_DEVICES is {visible!r}" in choice.reason
    assert reason in choice.reason and remedy in choice.remedy
    with pytest.raises(MachineError, match=r"run\.device is gpu, and OpenGL fell back to software") as caught:
        require_device("llvmpipe", "gpu", choice)
    told = str(caught.value)
    assert reason in told and remedy in told and told.endswith("or set run.device: any") and "\n" not in told
    note = require_device("llvmpipe", "any", choice)
    assert "draws in software" in note and reason in note and remedy in note and "run.device" not in note


def test_without_a_name_nothing_is_said_and_without_another_device_nothing_is_drawn(monkeypatch):
    for name in ("llvmpipe", "NVIDIA H100"):
        assert require_device(name, "any", Choice(0)) == ""
    with pytest.raises(MachineError, match=r"\(llvmpipe\): install the GPU's driver"):
        require_device("llvmpipe", "gpu", Choice(0))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7")
    monkeypatch.setattr(context, "list_devices", lambda: tuple(one for one in GPUS if one.is_nvidia))
    with pytest.raises(MachineError, match=r"could be opened \(CUDA_VISIBLE_DEVICES is '7', and EGL has EGL device 0"):
        context.choose()


def test_what_drivers_tell_of_their_devices_is_read(monkeypatch):
    """Of a library with two devices: an NVIDIA GPU, and one whose driver has no extension at all."""
    first, second = ctypes.c_void_p(1), ctypes.c_void_p(2)
    strings = {
        (1, context.EXTENSIONS): b"EGL_NV_device_cuda EGL_EXT_device_persistent_id EGL_EXT_device_drm",
        (1, context.DRM_FILE): b"/dev/dri/card3",
    }

    @ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
    def ask_number(device: int, name: int, value: int) -> int:
        ctypes.c_ssize_t.from_address(value).value = 5
        return int((device, name) == (1, context.CUDA_DEVICE))

    @ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_void_p, ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    def ask_bytes(device: int, name: int, most: int, value: int, size: int) -> int:
        ctypes.memmove(value, bytes(range(16)), 16)
        ctypes.c_int.from_address(size).value = 16
        return int((device, name, most) == (1, context.DEVICE_UUID, 16))

    functions = {"eglQueryDeviceAttribEXT": ask_number, "eglQueryDeviceBinaryEXT": ask_bytes}
    addresses = {name: ctypes.cast(function, ctypes.c_void_p).value for name, function in functions.items()}
    egl = SimpleNamespace(
        _eglQueryDevicesEXT=print,
        query_devices=lambda: [SimpleNamespace(_display=first), SimpleNamespace(_display=second)],
        _eglQueryDeviceStringEXT=lambda device, name: strings.get((device.value, name)),
        egl=SimpleNamespace(eglGetProcAddress=addresses.get),
    )
    monkeypatch.setattr(context, "load_egl", lambda: egl)
    gpu, other = context.list_devices.__wrapped__()
    assert gpu == GraphicsDevice(0, "/dev/dri/card3", True, 5, "GPU-00010203-0405-0607-0809-0a0b0c0d0e0f")
    assert describe(gpu) == f"EGL device 0 (/dev/dri/card3, CUDA 5, {gpu.uuid})"
    assert other == GraphicsDevice(1, "unnamed")


def test_a_context_is_opened_on_the_device_that_was_chosen_and_anew_where_that_changes(monkeypatch):
    """Of a list of two, of which the machine's own device stands second, then first."""
    egl: Any = context.load_egl()
    (own, *_), opened = egl.query_devices(), []
    gpus = tuple(GraphicsDevice(number, f"card{number}", True, number) for number in range(2))

    def device_at(index: int) -> object:
        opened.append(index)
        return own

    monkeypatch.setattr(gbuffer, "_shared", {})
    monkeypatch.setattr(context, "list_devices", lambda: gpus)
    monkeypatch.setattr(egl, "get_device_by_index", device_at)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    first = gbuffer.shared_renderer()
    assert (opened, gbuffer.shared_renderer() is first) == ([1], True)
    for visible, place in (("0", 0), ("1", 1)):
        before = gbuffer.shared_renderer()
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        now = gbuffer.shared_renderer()
        assert now is not before and now.choice == Choice(place)
        assert before._platform._egl_context is None and now._platform._egl_context is not None
    gbuffer.shared_renderer().close()
    monkeypatch.undo()
    gbuffer.shared_renderer()._platform.make_current()  # what other tests draw with
