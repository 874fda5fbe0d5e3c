"""The pixel counter: how many pixels a thing covers by itself, counted by the GPU without an image."""

from types import ModuleType

import numpy as np

from schemas.scene.camera import Intrinsics
from workers.render.raster.buffers import UploadedShape
from workers.render.raster.framebuffer import Framebuffer
from workers.render.raster.lit_shaders import EMPTY_FRAGMENT
from workers.render.raster.programs import Program, clip_from_cam
from workers.render.raster.shaders import COUNT_VERTEX
from workers.render.raster.tiles import TILE_PX

LAST_NUMBER = 255
"""The greatest number that a stencil of eight bits holds."""


class PixelCounter:
    """A stencil that lets each pixel pass once, and a query that counts what passes.

    Each count has a number of its own, which pixels take when they pass: so the stencil is cleared once in 255 counts.
    Each has a query of its own too: a driver draws what several of them count at once, when the first is finished.
    """

    def __init__(self, gl: ModuleType) -> None:
        self._gl = gl
        self.program = Program(gl, COUNT_VERTEX, EMPTY_FRAGMENT)
        self._unused: list[int] = []
        self._framebuffer = Framebuffer(gl, {gl.GL_STENCIL_ATTACHMENT: gl.GL_STENCIL_INDEX8})
        self._number = LAST_NUMBER

    def start(self, shape: UploadedShape, tile: Intrinsics) -> int:
        """The query of how many pixels of a tile, of at most `TILE_PX` a side, a shape covers; `program` holds its pose."""
        gl = self._gl
        self._framebuffer.bind(TILE_PX, TILE_PX)
        gl.glViewport(0, 0, tile.width, tile.height)
        gl.glDisable(gl.GL_DEPTH_TEST)
        gl.glEnable(gl.GL_STENCIL_TEST)
        if self._number == LAST_NUMBER:
            gl.glClearBufferiv(gl.GL_STENCIL, 0, np.zeros(1, np.int32))
            self._number = 0
        self._number += 1
        gl.glStencilFunc(gl.GL_NOTEQUAL, self._number, 0xFF)
        gl.glStencilOp(gl.GL_KEEP, gl.GL_REPLACE, gl.GL_REPLACE)
        self.program.set_view(tile, clip_from_cam(tile))
        query = self._unused.pop() if self._unused else int(np.ravel(gl.glGenQueries(1))[0])
        gl.glBeginQuery(gl.GL_SAMPLES_PASSED, query)
        for batch in shape.batches:
            gl.glBindVertexArray(batch.vertex_array)
            gl.glDrawElements(gl.GL_TRIANGLES, batch.index_count, gl.GL_UNSIGNED_INT, None)
        gl.glEndQuery(gl.GL_SAMPLES_PASSED)
        gl.glDisable(gl.GL_STENCIL_TEST)
        return query

    def finish(self, query: int) -> int:
        """The number of pixels of a query that was started."""
        self._unused.append(query)
        return int(np.ravel(self._gl.glGetQueryObjectuiv(query, self._gl.GL_QUERY_RESULT))[0])
