"""Framebuffers without multisampling: of one size at a time, and with a stencil for passes of colour alone."""

from collections.abc import Mapping
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from schemas.scene.appearance import Appearance
from schemas.scene.camera import Intrinsics
from workers.geometry.srgb import encode_srgb
from workers.render.raster.lit_shaders import MASK_FRAGMENT, MASK_VERTEX
from workers.render.raster.programs import Program


class Framebuffer:
    """Renderbuffers of the size that was bound last: views of one job have the same size."""

    def __init__(self, gl: ModuleType, formats: Mapping[int, int]) -> None:
        """`formats`: OpenGL's internal format of each attachment point."""
        self._gl, self._formats = gl, formats
        self._framebuffer = int(gl.glGenFramebuffers(1))
        self._buffers = [int(name) for name in np.ravel(gl.glGenRenderbuffers(len(formats)))]
        self.size = (0, 0)
        """Width and height, pixels."""

    def bind(self, width: int, height: int) -> None:
        """Draw into, and read from, this framebuffer. Raises RuntimeError where the driver refuses the size."""
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        gl.glViewport(0, 0, width, height)
        if self.size == (width, height):
            return
        for (point, form), buffer in zip(self._formats.items(), self._buffers, strict=True):
            gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
            gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, form, width, height)
            gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, point, gl.GL_RENDERBUFFER, buffer)
        colors = [point for point in self._formats if point in (gl.GL_COLOR_ATTACHMENT0, gl.GL_COLOR_ATTACHMENT1)]
        gl.glDrawBuffers(max(1, len(colors)), colors or [gl.GL_NONE])
        status = int(gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER))
        if status != gl.GL_FRAMEBUFFER_COMPLETE:
            raise RuntimeError(f"a framebuffer of {width} x {height} is not complete: status {status:#x}")
        self.size = (width, height)

    def clear(self, appearance: Appearance) -> None:
        """Set every pixel to the background, at no depth and infinitely far away."""
        gl = self._gl
        self.clear_depth()
        self.clear_color(np.append(encode_srgb(np.array(appearance.background)), 0.0))
        if gl.GL_COLOR_ATTACHMENT1 in self._formats:
            gl.glClearBufferfv(gl.GL_COLOR, 1, np.zeros(4, np.float32))

    def clear_depth(self) -> None:
        """Set every pixel infinitely far away: what the depth test compares falls with distance."""
        self._gl.glClearBufferfv(self._gl.GL_DEPTH, 0, np.zeros(1, np.float32))

    def clear_color(self, rgba: NDArray[np.floating]) -> None:
        """Set every pixel of the first colour attachment to [4] sRGB and region id / 255."""
        self._gl.glClearBufferfv(self._gl.GL_COLOR, 0, rgba)

    def limit_to(self, window: tuple[int, int, int, int] | None) -> bool:
        """Draw into the first colour attachment alone, and within a window, until called with None.

        The window is (left, top, right, bottom), right and bottom excluded. False, without a change, where it is empty.
        """
        gl = self._gl
        if window is None:
            gl.glDisable(gl.GL_SCISSOR_TEST)
        else:
            left, top, right, bottom = window
            if left >= right or top >= bottom:
                return False
            gl.glEnable(gl.GL_SCISSOR_TEST)
            gl.glScissor(left, top, right - left, bottom - top)
        gl.glColorMaski(1, *([window is None] * 4))
        return True

    def read(self, rgba: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Read the first colour attachment into `rgba` [H, W, 4], and return it."""
        gl = self._gl
        gl.glReadBuffer(gl.GL_COLOR_ATTACHMENT0)
        gl.glReadPixels(0, 0, *self.size, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, rgba)
        return rgba


class ColourTarget(Framebuffer):
    """Colour, depth, and a stencil of the pixels to draw: other sample points of edge pixels, textures with holes cut out.

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
