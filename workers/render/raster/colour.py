"""The framebuffer of passes for colour alone: other sample points of edge pixels, and textures with holes cut out."""

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from schemas.scene.camera import Intrinsics
from schemas.scene.scene import Appearance
from workers.geometry.srgb import encode_srgb
from workers.render.raster.framebuffer import Framebuffer
from workers.render.raster.lit_shaders import MASK_FRAGMENT, MASK_VERTEX
from workers.render.raster.programs import Program


class ColourTarget:
    """Colour, depth, and a stencil of the pixels to draw.

    Depth falls with distance, as in the label pass. Hidden fragments and those outside the stencil are dropped before they
    are shaded.
    """

    def __init__(self, gl: ModuleType) -> None:
        self._gl = gl
        self._stencil = Program(gl, MASK_VERTEX, MASK_FRAGMENT)
        self._empty = int(gl.glGenVertexArrays(1))
        formats = {gl.GL_COLOR_ATTACHMENT0: gl.GL_RGBA8, gl.GL_DEPTH_STENCIL_ATTACHMENT: gl.GL_DEPTH32F_STENCIL8}
        self._framebuffer = Framebuffer(gl, formats)
        self._mask = int(gl.glGenTextures(1))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self._framebuffer.size

    def select(self, mask: NDArray[np.uint8] | None, k: Intrinsics) -> None:
        """Bind the framebuffer, and draw only where `mask` [H, W] is not 0; None: everywhere."""
        gl = self._gl
        self._framebuffer.bind(k.width, k.height)
        if mask is None:
            return
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

    def clear(self, appearance: Appearance) -> None:
        """Set every pixel to the background, infinitely far away."""
        gl = self._gl
        background = np.append(encode_srgb(np.array(appearance.background)), 0.0)
        gl.glClearBufferfv(gl.GL_COLOR, 0, background.astype(np.float32))
        gl.glClearBufferfv(gl.GL_DEPTH, 0, np.zeros(1, np.float32))

    def read(self) -> NDArray[np.uint8]:
        """[H, W, 4] uint8 sRGB."""
        gl, (width, height) = self._gl, self.size
        rgba = np.empty((height, width, 4), np.uint8)
        gl.glReadBuffer(gl.GL_COLOR_ATTACHMENT0)
        gl.glReadPixels(0, 0, width, height, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, rgba)
        return rgba

    def release(self) -> None:
        """Switch the stencil test off, as the label pass needs it."""
        self._gl.glDisable(self._gl.GL_STENCIL_TEST)

    def free(self) -> None:
        """Free its memory on the GPU."""
        self._framebuffer.free()
        self._gl.glDeleteTextures(1, [self._mask])
        self._gl.glDeleteVertexArrays(1, [self._empty])
        self._stencil.free()
