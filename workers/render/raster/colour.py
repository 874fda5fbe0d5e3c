"""Where colour is drawn without labels: once more at other points of the pixels that show edges, or with holes cut out."""

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from schemas.scene.appearance import Appearance
from schemas.scene.camera import Intrinsics
from workers.geometry.srgb import encode_srgb
from workers.render.raster.lit_shaders import MASK_FRAGMENT, MASK_VERTEX
from workers.render.raster.programs import Program

PIXEL_BYTES = 4 + 8 + 1
"""Colour, depth with stencil, mask."""


class ColourTarget:
    """A framebuffer of one size, the last that was asked for: colour, depth, and a stencil of the pixels to draw.

    Depth falls with distance here, as in the pass for labels: fragments behind others are dropped before they are
    shaded, and so is everything outside the stencil.
    """

    def __init__(self, gl: ModuleType) -> None:
        self._gl = gl
        self._stencil = Program(gl, MASK_VERTEX, MASK_FRAGMENT)
        self._empty = int(gl.glGenVertexArrays(1))
        self._framebuffer = int(gl.glGenFramebuffers(1))
        self._color, self._depth = (int(name) for name in gl.glGenRenderbuffers(2))
        self._mask = int(gl.glGenTextures(1))
        self.size = (0, 0)

    @property
    def bytes(self) -> int:
        """On the GPU."""
        return PIXEL_BYTES * self.size[0] * self.size[1]

    def select(self, mask: NDArray[np.uint8] | None, k: Intrinsics) -> None:
        """Bind the framebuffer and let only the pixels pass where `mask` [H, W] is not 0; None: all of them."""
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        if self.size != (k.width, k.height):
            self._resize(k.width, k.height)
        gl.glViewport(0, 0, k.width, k.height)
        if mask is None:
            return
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._mask)
        gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
        gl.glTexSubImage2D(gl.GL_TEXTURE_2D, 0, 0, 0, k.width, k.height, gl.GL_RED, gl.GL_UNSIGNED_BYTE, mask)
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
        """The background everywhere, and nothing in front of it."""
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
        """Leave the tests as the label pass wants them."""
        self._gl.glDisable(self._gl.GL_STENCIL_TEST)

    def free(self) -> None:
        """Give the GPU's memory back."""
        gl = self._gl
        gl.glDeleteFramebuffers(1, [self._framebuffer])
        gl.glDeleteRenderbuffers(2, [self._color, self._depth])
        gl.glDeleteTextures(1, [self._mask])
        gl.glDeleteVertexArrays(1, [self._empty])
        self._stencil.free()

    def _resize(self, width: int, height: int) -> None:
        gl = self._gl
        for name, form, point in (
            (self._color, gl.GL_RGBA8, gl.GL_COLOR_ATTACHMENT0),
            (self._depth, gl.GL_DEPTH32F_STENCIL8, gl.GL_DEPTH_STENCIL_ATTACHMENT),
        ):
            gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, name)
            gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, form, width, height)
            gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, point, gl.GL_RENDERBUFFER, name)
        status = int(gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER))
        if status != gl.GL_FRAMEBUFFER_COMPLETE:
            raise RuntimeError(f"a framebuffer of {width} x {height} is not complete: status {status:#x}")
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._mask)
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, gl.GL_R8, width, height, 0, gl.GL_RED, gl.GL_UNSIGNED_BYTE, None)
        for setting in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, setting, gl.GL_NEAREST)
        self.size = (width, height)
