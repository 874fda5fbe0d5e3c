"""Plain calls of OpenGL, without PyOpenGL's checks.

Which device draws, and what is said where none can. Framebuffers are cleared and read in the size that was bound
last; passes for colour alone show holes in textures.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Material, Part, Shape
from tests.workers.render.looks import BLACK, FOUR, RASTER
from tests.workers.render.random_scenes import EYE, camera, facing, quad, small
from workers.geometry.colour import encode_srgb
from workers.render.raster.context import Framebuffer, is_software
from workers.render.raster.draw_calls import Program

VERTEX = "#version 410 core\nuniform mat4 m; void main() { gl_Position = m * vec4(1.0); }"
FRAGMENT = "#version 410 core\nout vec4 o; void main() { o = vec4(1.0); }"


def test_an_error_of_a_plain_call_is_raised_by_the_next_checked_one(renderer):
    gl = renderer._gl
    gl.glEnable(0xFFFF)
    with pytest.raises(gl.GLError, match="1280"):
        gl.glGetFloatv(gl.GL_VIEWPORT)
    assert gl.glGetError() == gl.GL_NO_ERROR


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


ROOT = Path(__file__).resolve().parents[4]


@pytest.mark.parametrize(
    ("name", "software"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True),
        ("softpipe", True),
        ("Software Rasterizer", True),
        ("SWR (LLVM 11.0.0, 256 bits)", True),
        ("ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (LLVM 10.0.0) (0x0000C0DE)), SwiftShader driver)", True),
        ("NVIDIA H100 80GB HBM3/PCIe/SSE2", False),
        ("Mesa Intel(R) UHD Graphics 630 (CFL GT2)", False),
        ("AMD Radeon RX 6800 (radeonsi, navi21, LLVM 15.0.7, DRM 3.49, 6.1.0)", False),
    ],
)
def test_software_is_told_from_a_gpu_by_its_name(name, software):
    assert is_software(name) == software


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


@pytest.mark.parametrize("sizes", [[(8, 6)], [(8, 6), (40, 3), (8, 6)]], ids=["one", "resized"])
def test_a_cleared_framebuffer_shows_the_background_in_every_pixel(renderer, sizes):
    gl = renderer._gl
    target = Framebuffer(gl, {gl.GL_COLOR_ATTACHMENT0: gl.GL_RGBA8, gl.GL_DEPTH_ATTACHMENT: gl.GL_DEPTH_COMPONENT32F})
    background = (0.2, 0.5, 0.8)
    for width, height in sizes:
        target.bind(width, height)
        assert target.size == (width, height)
        target.clear(Appearance((0.0,) * 3, (), background))
        seen = target.read(np.zeros((height, width, 4), np.uint8))
        assert np.abs(seen[..., :3] - 255.0 * encode_srgb(np.array(background))).max() <= 0.51
        assert (seen[..., 3] == 0).all()


@pytest.mark.parametrize("render", [RASTER, FOUR])
def test_through_a_hole_in_a_texture_one_sees_what_is_behind_and_labels_are_solid(renderer, render):
    texture = np.full((8, 8, 4), 255, np.uint8)
    texture[:, :4, 3] = 0
    (part,) = facing(2.0, 1.0).parts
    uv = frozen_array([[0, 0], [1, 0], [1, 1], [0, 1]])
    red = Material((1.0, 0.0, 0.0, 1.0), texture=texture)
    front = Shape((Part("front", part.vertices, part.faces, red, uv=uv),))
    behind = quad([[-9, -9, 4], [9, -9, 4], [9, 9, 4], [-9, 9, 4]], material=Material((0.0, 0.0, 1.0, 1.0)))
    look = Appearance((0.7,) * 3, (), BLACK, (0.7,) * 3)
    things = [Placed(2, behind, EYE), Placed(3, front, EYE)]
    seen = renderer.draw(things, look, camera(small(40, 40)), *render)
    left, right = seen.rgb[20, 13], seen.rgb[20, 27]
    assert left[2] > 150 > 100 > left[0]
    assert right[0] > 150 > 100 > right[2]
    assert (seen.region[11:29, 11:29] == 3).all()
    assert np.abs(seen.depth_m[11:29, 11:29] - 2.0).max() < 1e-5
