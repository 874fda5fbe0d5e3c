"""What is kept on the GPU and how it gets there: packing, stores that are bounded, plain calls, framebuffers; which of EGL's
devices a process draws on, for what Ray and users put into CUDA_VISIBLE_DEVICES.
"""

import ctypes
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.errors import MachineError
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Material, Part, Shape
from tests.workers.render.random_scenes import APPEARANCE, EYE, camera, facing, part_of, shape_of, small
from workers.geometry.colour import decode_srgb, encode_srgb
from workers.geometry.frames import translation
from workers.render.raster import context, gbuffer
from workers.render.raster.batches import pack_shape
from workers.render.raster.buffers import MAX_SHAPES, TextureStore, mip_levels
from workers.render.raster.context import (
    Choice,
    Framebuffer,
    GraphicsDevice,
    choose_device,
    describe,
    is_software,
    require_device,
)
from workers.render.raster.draw_calls import Program

ROOT = Path(__file__).resolve().parents[3]
BOX = trimesh.creation.box((1.0, 2.0, 3.0))


def test_faces_of_the_top_come_first_and_are_planar_where_normals_are_upright_and_colours_one():
    (batch,) = pack_shape(Shape((part_of(BOX),)))
    highest = batch.vertices[batch.indices, 2] == np.float32(1.5)
    assert batch.top_faces == 2 and batch.planar_top
    assert highest.all(axis=1).tolist() == [True] * 2 + [False] * 10
    plain = part_of(BOX)
    upside_down = replace(plain, faces=frozen_array(BOX.faces[:, ::-1], np.int32))
    assert pack_shape(Shape((upside_down,)))[0].top_faces == 0, "a face seen from below only is no top"
    upright, top = np.tile([0.0, 0.0, 1.0], (8, 1)), plain.vertices[:, 2] > 0.0
    tilted, below = upright.copy(), upright.copy()
    tilted[np.flatnonzero(top)[0]], below[~top] = (0.01, 0.0, 1.0), (1.0, 0.0, 0.0)
    one, two = np.full((8, 4), 200, np.uint8), np.full((8, 4), 200, np.uint8)
    two[np.flatnonzero(top)[0], 1] = 201
    for change, planar in (
        ({"normals": frozen_array(upright)}, True),
        ({"normals": frozen_array(below)}, True),
        ({"normals": frozen_array(tilted)}, False),
        ({"colors": one}, True),
        ({"colors": two}, False),
    ):
        (batch,) = pack_shape(Shape((replace(plain, **change),)))
        assert (batch.planar, batch.planar_top) == (False, planar), change


# ---------------------------------------------------------------------------------------------- stores


def test_levels_halve_down_to_one_pixel_and_keep_the_mean():
    """Of 255 times the root of linear light."""
    image = np.random.default_rng(0).integers(0, 256, (64, 32, 3), dtype=np.uint8)
    levels, mean = mip_levels(image), (255.0 * np.sqrt(decode_srgb(image / 255.0))).mean(axis=(0, 1))
    assert [level.shape for level in levels] == [(64 >> i, max(1, 32 >> i), 4) for i in range(7)]
    for level in levels:
        assert np.abs(level[..., :3].mean(axis=(0, 1)) - mean).max() < 2.0
        assert (level[..., 3] == 255).all()


class Driver:
    """Counts what is made and what is freed."""

    def __init__(self) -> None:
        self.made = 0
        self.freed: list[int] = []

    def glGenTextures(self, count: int) -> int:
        self.made += 1
        return self.made

    def glDeleteTextures(self, count: int, names: list[int]) -> None:
        self.freed += names

    def __getattr__(self, name: str) -> object:
        return 0 if name.isupper() or name.startswith("GL_") else lambda *arguments: None


def test_a_picture_is_uploaded_once_and_kept_while_there_is_room():
    driver = Driver()
    store = TextureStore(driver, max_bytes=3 * 4 * 341)  # three pictures of 16 x 16 with their levels
    pictures = [np.full((16, 16, 3), n, np.uint8) for n in range(4)]
    first = store.take(pictures[0])
    assert store.take(pictures[0]) is first and driver.made == 1
    store.give_back(first)
    store.give_back(first)
    assert store.take(pictures[0]) is first, "kept without a use"
    store.give_back(first)
    others = [store.take(picture) for picture in pictures[1:]]
    assert not store.fits and driver.freed == []
    store.give_back(others[0])
    assert driver.freed == [first.name], "the longest unused goes first"
    assert store.fits and len(store) == 3


@pytest.mark.minute
def test_shapes_and_framebuffers_on_the_gpu_are_bounded(renderer):
    def draw_at(shape, k):
        renderer.draw([Placed(3, shape, translation(0, 0, 1))], APPEARANCE, camera(k))

    held = [shape_of(trimesh.creation.icosphere(0, 0.1)) for _ in range(MAX_SHAPES + 1)]
    for shape in held:
        draw_at(shape, small(16, 16))
    assert len(renderer._shapes) == MAX_SHAPES and held[0] not in renderer._shapes
    del held, shape
    for n in range(100):
        draw_at(shape_of(trimesh.creation.icosphere(1, 0.1)), small(16 + 8 * n, 512))
    assert len(renderer._shapes) <= 2, "what only a scene held went with it"
    assert renderer._target.size == (16 + 8 * 99, 512), "one framebuffer is kept"


@pytest.mark.minute
def test_memory_stays_flat_over_scenes_with_new_meshes(renderer, record_figure):
    """300 scenes, each with a new 5,000-face object and a new texture; the first 100 fill the stores."""
    texture, view, resident = np.zeros((256, 256, 3), np.uint8), camera(small(160, 120)), []
    for n in range(300):
        (part,) = facing(2.0).parts
        textured = Part("p", part.vertices, part.faces, Material(texture=texture.copy()), uv=part.vertices[:, :2])
        ball = Placed(3, shape_of(trimesh.creation.icosphere(4, 0.1)), translation(0, 0, 1))
        renderer.draw([ball, Placed(2, Shape((textured,)), EYE)], APPEARANCE, view)
        renderer.count_pixels([ball], view)
        if n % 100 == 99:
            resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20)
    growth = resident[2] - resident[1]
    record_figure("render memory growth over 100 scenes, MiB", "passed", growth, 8.0)
    assert growth < 8.0, f"resident memory, MiB: {resident}"


# ---------------------------------------------------------------------------------------------- the context


def test_an_error_of_a_plain_call_is_raised_by_the_next_checked_one(renderer):
    gl = renderer._gl
    gl.glEnable(0xFFFF)
    with pytest.raises(gl.GLError, match="1280"):
        gl.glGetFloatv(gl.GL_VIEWPORT)
    assert gl.glGetError() == gl.GL_NO_ERROR


def test_a_matrix_arrives_whatever_its_type_and_order_in_memory(renderer):
    vertex = "#version 410 core\nuniform mat4 m; void main() { gl_Position = m * vec4(1.0); }"
    fragment = "#version 410 core\nout vec4 o; void main() { o = vec4(1.0); }"
    gl, program = renderer._gl, Program(renderer._gl, vertex, fragment)
    program.use()
    for order in ("C", "F"):
        for dtype in (np.float32, np.float64):
            matrix = np.arange(16.0).reshape(4, 4).astype(dtype, order=order)
            gl.glUniformMatrix4fv(program._location("m"), 1, True, matrix)
            arrived = np.zeros(16, np.float32)
            gl.glGetUniformfv(program._name, program._location("m"), arrived)
            assert np.array_equal(arrived.reshape(4, 4).T, matrix)
    gl.glDeleteProgram(program._name)


def test_a_cleared_framebuffer_shows_the_background_in_every_pixel_also_after_another_size(renderer):
    gl, background = renderer._gl, (0.2, 0.5, 0.8)
    target = Framebuffer(gl, {gl.GL_COLOR_ATTACHMENT0: gl.GL_RGBA8, gl.GL_DEPTH_ATTACHMENT: gl.GL_DEPTH_COMPONENT32F})
    for width, height in ((8, 6), (40, 3), (8, 6)):
        target.bind(width, height)
        assert target.size == (width, height)
        target.clear(Appearance((0.0,) * 3, (), background))
        seen = target.read(np.zeros((height, width, 4), np.uint8))
        assert np.abs(seen[..., :3] - 255.0 * encode_srgb(np.array(background))).max() <= 0.51
        assert (seen[..., 3] == 0).all()


def test_software_is_told_from_a_gpu_by_its_name():
    software = (
        *("llvmpipe (LLVM 15.0.6, 256 bits)", "softpipe", "Software Rasterizer", "SWR (LLVM 11.0.0, 256 bits)"),
        "ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (LLVM 10.0.0) (0x0000C0DE)), SwiftShader driver)",
    )
    hardware = (
        *("NVIDIA H100 80GB HBM3/PCIe/SSE2", "Mesa Intel(R) UHD Graphics 630 (CFL GT2)"),
        "AMD Radeon RX 6800 (radeonsi, navi21, LLVM 15.0.7, DRM 3.49, 6.1.0)",
    )
    assert [name for name in (*software, *hardware) if is_software(name)] == list(software)


def test_a_machine_whose_egl_has_no_device_is_told_so():
    done = subprocess.run(
        [sys.executable, "-c", "from workers.render.raster.context import open_context; open_context()"],
        cwd=ROOT,
        env={**os.environ, "__EGL_VENDOR_LIBRARY_FILENAMES": "/dev/null"},
        capture_output=True,
        text=True,
        check=False,
    )
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("schemas.errors.MachineError: no OpenGL context could be opened (EGL has no device)")
    assert "apt-get install -y libgl1 libegl1 libgl1-mesa-dri" in last


# ---------------------------------------------------------------------------------------------- devices

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
