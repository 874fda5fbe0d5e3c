"""What lives on the GPU: shapes and framebuffers, and bounded stores of both.

Everything takes `gl`, the module that `open_context` loaded: nothing here loads OpenGL when it is imported.
"""

import ctypes
from collections import OrderedDict
from dataclasses import dataclass
from itertools import product
from types import ModuleType

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Shape
from workers.render.raster.batches import COLUMNS, Batch, pack_shape
from workers.render.raster.textures import Texture, TextureStore

FLOAT_BYTES = INDEX_BYTES = 4

FEW_TRIANGLES = 1000
"""Up to here a batch is drawn by the variant of the label pass that is fast for each pixel, above by the other."""

TARGET_PIXEL_BYTES = 12
"""Colour 4, z 4, depth 4."""


@dataclass(frozen=True)
class Uploaded:
    """One batch on the GPU."""

    vertex_array: int
    buffers: tuple[int, int]
    texture: Texture | None
    index_count: int
    top_count: int
    """The first so many indices are of the shape's top (batches.py)."""
    matte: bool
    bytes: int
    """Without its texture's."""

    @property
    def holes(self) -> bool:
        """Its texture has texels that are cut out of colour."""
        return self.texture is not None and self.texture.holes

    @property
    def few_triangles(self) -> bool:
        """Which variant of the label pass draws it fastest."""
        return self.index_count <= 3 * FEW_TRIANGLES

    def free(self, gl: ModuleType) -> None:
        """Give the GPU's memory back."""
        gl.glDeleteVertexArrays(1, [self.vertex_array])
        gl.glDeleteBuffers(2, self.buffers)


@dataclass(frozen=True, eq=False)
class UploadedShape:
    """A shape on the GPU: its batches, the corners [8, 3] of its bounding box, and whether its bodies are closed."""

    batches: tuple[Uploaded, ...]
    corners: Array
    closed: bool

    @property
    def bytes(self) -> int:
        """On the GPU."""
        return sum(batch.bytes for batch in self.batches)


class ShapeStore:
    """Shapes on the GPU, by identity; the longest unused go when there are too many or they are too big.

    A stored shape is held, so that no other object can take its id.
    """

    def __init__(self, gl: ModuleType, max_shapes: int = 16, max_bytes: int = 64 * 2**20) -> None:
        self._gl = gl
        self.textures = TextureStore(gl)
        self._max_shapes, self._max_bytes = max_shapes, max_bytes
        self._stored: OrderedDict[int, tuple[Shape, UploadedShape]] = OrderedDict()
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._stored)

    def __contains__(self, shape: Shape) -> bool:
        return id(shape) in self._stored

    def fetch(self, shape: Shape) -> UploadedShape:
        """The shape, uploaded now if it is not there."""
        if shape in self:
            self._stored.move_to_end(id(shape))
            return self._stored[id(shape)][1]
        batches = tuple(_upload(self._gl, batch, self.textures) for batch in pack_shape(shape))
        corners = np.array(list(product(*shape.bounds.T)))
        uploaded = UploadedShape(batches, corners, shape.closed)
        self._stored[id(shape)] = (shape, uploaded)
        self.bytes += uploaded.bytes
        return uploaded

    def trim(self, in_use: int) -> None:
        """Free the longest unused until the bounds hold, but not the `in_use` shapes that were fetched last."""
        while len(self._stored) > in_use and not self._fit():
            self._drop_oldest()

    def _fit(self) -> bool:
        return len(self._stored) <= self._max_shapes and self.bytes <= self._max_bytes and self.textures.fit

    def clear(self) -> None:
        """Free everything."""
        while self._stored:
            self._drop_oldest()
        self.textures.clear()

    def _drop_oldest(self) -> None:
        _, (_, uploaded) = self._stored.popitem(last=False)
        self.bytes -= uploaded.bytes
        for batch in uploaded.batches:
            batch.free(self._gl)
            if batch.texture is not None:
                self.textures.give_back(batch.texture)


@dataclass(frozen=True)
class Target:
    """A framebuffer without multisampling: colour with the region id as its fourth byte, linear z, and depth."""

    width: int
    height: int
    framebuffer: int
    attachments: tuple[int, int, int]

    @staticmethod
    def of_size(gl: ModuleType, width: int, height: int) -> "Target":
        """Made, bound and complete; raises RuntimeError where the driver refuses it."""
        colour, z, depth = (int(name) for name in gl.glGenRenderbuffers(3))
        framebuffer = int(gl.glGenFramebuffers(1))
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, framebuffer)
        for name, form, point in (
            (colour, gl.GL_RGBA8, gl.GL_COLOR_ATTACHMENT0),
            (z, gl.GL_R32F, gl.GL_COLOR_ATTACHMENT1),
            (depth, gl.GL_DEPTH_COMPONENT32F, gl.GL_DEPTH_ATTACHMENT),
        ):
            gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, name)
            gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, form, width, height)
            gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, point, gl.GL_RENDERBUFFER, name)
        gl.glDrawBuffers(2, [gl.GL_COLOR_ATTACHMENT0, gl.GL_COLOR_ATTACHMENT1])
        status = int(gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER))
        if status != gl.GL_FRAMEBUFFER_COMPLETE:
            raise RuntimeError(f"a framebuffer of {width} x {height} is not complete: status {status:#x}")
        return Target(width, height, framebuffer, (colour, z, depth))

    @property
    def bytes(self) -> int:
        """On the GPU."""
        return TARGET_PIXEL_BYTES * self.width * self.height

    def free(self, gl: ModuleType) -> None:
        """Give the GPU's memory back."""
        gl.glDeleteFramebuffers(1, [self.framebuffer])
        gl.glDeleteRenderbuffers(3, self.attachments)


class TargetStore:
    """One framebuffer a size; the longest unused go when they are too big together."""

    def __init__(self, gl: ModuleType, max_bytes: int = 64 * 2**20) -> None:
        self._gl = gl
        self._max_bytes = max_bytes
        self._stored: OrderedDict[tuple[int, int], Target] = OrderedDict()

    def __len__(self) -> int:
        return len(self._stored)

    def bind(self, width: int, height: int) -> None:
        """Draw into, and read from, the whole of the framebuffer of this size."""
        gl, size = self._gl, (width, height)
        if size not in self._stored:
            self._stored[size] = Target.of_size(gl, width, height)
        self._stored.move_to_end(size)
        while len(self._stored) > 1 and sum(target.bytes for target in self._stored.values()) > self._max_bytes:
            self._stored.popitem(last=False)[1].free(gl)
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._stored[size].framebuffer)
        gl.glViewport(0, 0, width, height)

    def clear(self) -> None:
        """Free everything."""
        for target in self._stored.values():
            target.free(self._gl)
        self._stored.clear()


def _upload(gl: ModuleType, batch: Batch, textures: TextureStore) -> Uploaded:
    vertex_array = int(gl.glGenVertexArrays(1))
    vertex_buffer, index_buffer = (int(name) for name in gl.glGenBuffers(2))
    gl.glBindVertexArray(vertex_array)
    gl.glBindBuffer(gl.GL_ARRAY_BUFFER, vertex_buffer)
    gl.glBufferData(gl.GL_ARRAY_BUFFER, batch.vertices.nbytes, batch.vertices, gl.GL_STATIC_DRAW)
    gl.glBindBuffer(gl.GL_ELEMENT_ARRAY_BUFFER, index_buffer)
    gl.glBufferData(gl.GL_ELEMENT_ARRAY_BUFFER, batch.indices.nbytes, batch.indices, gl.GL_STATIC_DRAW)
    stride, offset = FLOAT_BYTES * batch.vertices.shape[1], 0
    for location, size in enumerate(COLUMNS.values()):
        gl.glVertexAttribPointer(location, size, gl.GL_FLOAT, gl.GL_FALSE, stride, ctypes.c_void_p(offset))
        gl.glEnableVertexAttribArray(location)
        offset += FLOAT_BYTES * size
    gl.glBindVertexArray(0)
    texture = None if batch.texture is None else textures.take(batch.texture)
    size = batch.vertices.nbytes + batch.indices.nbytes
    buffers = (vertex_buffer, index_buffer)
    return Uploaded(vertex_array, buffers, texture, batch.indices.size, 3 * batch.top_faces, batch.matte, size)
