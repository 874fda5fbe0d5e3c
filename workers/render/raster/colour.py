"""The framebuffer of passes for colour alone: other sample points of edge pixels, and textures with holes cut out."""

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from schemas.scene.camera import Intrinsics
from workers.render.raster.framebuffer import Framebuffer
from workers.render.raster.lit_shaders import MASK_FRAGMENT, MASK_VERTEX
from workers.render.raster.programs import Program


class ColourTarget(Framebuffer):
    """Colour, depth, and a stencil of the pixels to draw.

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
