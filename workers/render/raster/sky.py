"""The picture of the light from all around, where no surface is, in tier raster: drawn behind all that was drawn before."""

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from schemas.scene.shape import Surround
from workers.geometry.frames import UP, rotation_about
from workers.render.raster.draw_calls import Program, RenderPass
from workers.render.raster.shaders import sky_sources

BRIGHTEST = 6e4
"""Half precision ends there; all above is white."""


class Sky:
    """Draws pictures of surrounds; keeps the last one on the GPU."""

    def __init__(self, gl: ModuleType) -> None:
        self._gl = gl
        self._program: Program | None = None
        self._texture, self._empty = 0, 0
        self._uploaded: NDArray[np.float32] | None = None

    def draw(self, view: RenderPass, surround: Surround) -> None:
        """Fill what no surface covers of the bound framebuffer's colour, which stays of region 0."""
        gl = self._gl
        if self._program is None:
            self._program, self._empty = Program(gl, *sky_sources()), int(gl.glGenVertexArrays(1))
        gl.glColorMaski(1, *([False] * 4))
        gl.glDepthMask(False)
        gl.glDepthFunc(gl.GL_EQUAL)
        self._program.use()
        self._program.set_view(view.k)
        map_from_world = rotation_about(UP, -surround.turn_rad)
        self._program.set_sky(map_from_world @ view.T_cam_world[:3, :3].T, surround.scale)
        gl.glBindVertexArray(self._empty)
        self._bind(surround.radiance)
        gl.glDrawArrays(gl.GL_TRIANGLES, 0, 3)
        gl.glDepthFunc(gl.GL_GREATER)
        gl.glDepthMask(True)
        gl.glColorMaski(1, *([True] * 4))

    def _bind(self, radiance: NDArray[np.float32]) -> None:
        gl = self._gl
        if not self._texture:
            self._texture = int(gl.glGenTextures(1))
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._texture)
        if self._uploaded is radiance:
            return
        height, width = radiance.shape[:2]
        gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
        form = (gl.GL_RGB16F, width, height, 0, gl.GL_RGB, gl.GL_FLOAT, np.minimum(radiance, np.float32(BRIGHTEST)))
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, *form)
        for setting, value in (
            (gl.GL_TEXTURE_MIN_FILTER, gl.GL_LINEAR),
            (gl.GL_TEXTURE_MAG_FILTER, gl.GL_LINEAR),
            (gl.GL_TEXTURE_WRAP_S, gl.GL_REPEAT),
            (gl.GL_TEXTURE_WRAP_T, gl.GL_CLAMP_TO_EDGE),
        ):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, setting, value)
        self._uploaded = radiance
