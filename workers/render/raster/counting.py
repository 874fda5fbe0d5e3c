"""How many pixels a thing alone would cover: counted by the GPU, without an image."""

from types import ModuleType

import numpy as np

from schemas.scene.camera import Intrinsics
from workers.render.raster.buffers import UploadedShape
from workers.render.raster.programs import Program
from workers.render.raster.shaders import COUNT_FRAGMENT, COUNT_VERTEX
from workers.render.raster.tiles import TILE_PX

TARGET_BYTES = 4 * TILE_PX * TILE_PX
"""Depth, which is not used, and stencil."""


class PixelCounter:
    """A stencil that lets each pixel pass once, and a query that counts what passes."""

    def __init__(self, gl: ModuleType) -> None:
        self._gl = gl
        self.program = Program(gl, COUNT_VERTEX, COUNT_FRAGMENT)
        self._query = int(np.ravel(gl.glGenQueries(1))[0])
        self._stencil = int(gl.glGenRenderbuffers(1))
        self._framebuffer = int(gl.glGenFramebuffers(1))
        gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, self._stencil)
        gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, gl.GL_DEPTH24_STENCIL8, TILE_PX, TILE_PX)
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        attached = (gl.GL_DEPTH_STENCIL_ATTACHMENT, gl.GL_RENDERBUFFER, self._stencil)
        gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, *attached)
        gl.glDrawBuffer(gl.GL_NONE)

    def count(self, shape: UploadedShape, tile: Intrinsics) -> int:
        """Pixels of a tile, of at most `TILE_PX` a side, that the shape covers; `program` must know where it stands."""
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        gl.glViewport(0, 0, tile.width, tile.height)
        gl.glDisable(gl.GL_DEPTH_TEST)
        gl.glEnable(gl.GL_STENCIL_TEST)
        gl.glStencilFunc(gl.GL_EQUAL, 0, 0xFF)
        gl.glStencilOp(gl.GL_KEEP, gl.GL_INCR, gl.GL_INCR)
        gl.glScissor(0, 0, tile.width, tile.height)
        gl.glEnable(gl.GL_SCISSOR_TEST)
        gl.glClearBufferiv(gl.GL_STENCIL, 0, np.zeros(1, np.int32))
        gl.glDisable(gl.GL_SCISSOR_TEST)
        self.program.set_view(tile)
        gl.glBeginQuery(gl.GL_SAMPLES_PASSED, self._query)
        for batch in shape.batches:
            gl.glBindVertexArray(batch.vertex_array)
            gl.glDrawElements(gl.GL_TRIANGLES, batch.index_count, gl.GL_UNSIGNED_INT, None)
        gl.glEndQuery(gl.GL_SAMPLES_PASSED)
        gl.glDisable(gl.GL_STENCIL_TEST)
        return int(np.ravel(gl.glGetQueryObjectuiv(self._query, gl.GL_QUERY_RESULT))[0])

    def free(self) -> None:
        """Give the GPU's memory back."""
        self._gl.glDeleteQueries(1, [self._query])
        self._gl.glDeleteFramebuffers(1, [self._framebuffer])
        self._gl.glDeleteRenderbuffers(1, [self._stencil])
        self.program.free()
