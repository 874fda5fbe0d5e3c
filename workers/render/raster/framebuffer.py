"""A framebuffer without multisampling, of one size at a time."""

from collections.abc import Mapping
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from schemas.scene.appearance import Appearance
from workers.geometry.srgb import encode_srgb


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
        """Set every pixel to the background, infinitely far away: depth falls with distance."""
        gl = self._gl
        background = np.append(encode_srgb(np.array(appearance.background)), 0.0)
        gl.glClearBufferfv(gl.GL_COLOR, 0, background.astype(np.float32))
        if gl.GL_COLOR_ATTACHMENT1 in self._formats:
            gl.glClearBufferfv(gl.GL_COLOR, 1, np.zeros(4, np.float32))
        gl.glClearBufferfv(gl.GL_DEPTH, 0, np.zeros(1, np.float32))

    def read(self, rgba: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Read the first colour attachment into `rgba` [H, W, 4], and return it."""
        gl = self._gl
        gl.glReadBuffer(gl.GL_COLOR_ATTACHMENT0)
        gl.glReadPixels(0, 0, *self.size, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, rgba)
        return rgba
