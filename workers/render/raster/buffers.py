"""Shapes on the GPU: vertex and index buffers and textures, and a bounded store of them.

Textures are shared by the identity of their pictures, as scenes share those of floors and labels. Everything takes `gl`, the
module that `open_context` loaded: importing this module loads no OpenGL.
"""

import ctypes
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from types import ModuleType
from weakref import ref

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Shape
from workers.geometry.colour import SRGB_STEPS, has_holes
from workers.geometry.mesh import bounds_of
from workers.render.raster.batches import COLUMNS, Batch, Cover, find_cover, pack_shape

MAX_TEXTURE_PX = 2048
"""Greatest width and height of an uploaded texture; a larger picture is scaled down."""

_ROOT = np.rint(255.0 * np.sqrt(SRGB_STEPS)).astype(np.uint8)
"""[256] uint8: the root of the linear light of each sRGB code, in 255ths."""

_ROOTS = np.stack([_ROOT] * 3 + [np.arange(256, dtype=np.uint8)], axis=-1)[:, None, :]
"""[256, 1, 4] uint8: the same for red, green and blue; alpha unchanged."""


@dataclass(eq=False)
class Texture:
    """A picture on the GPU, and the number of batches that use it."""

    picture: ref[NDArray[np.uint8]]
    name: int
    bytes: int
    holes: bool
    """Whether some texels are cut out of colour."""
    uses: int = 0


class TextureStore:
    """Textures in use, and the most recently used others that something still holds while all fit into `max_bytes`."""

    def __init__(self, gl: ModuleType, max_bytes: int = 128 * 2**20) -> None:
        self._gl, self._max_bytes = gl, max_bytes
        self._stored: OrderedDict[int, Texture] = OrderedDict()
        self.bytes = 0

    @cached_property
    def white(self) -> int:
        """A texture that multiplies by one, for surfaces without their own."""
        return upload_texture(self._gl, mip_levels(np.full((1, 1, 3), 255, np.uint8)))

    def __len__(self) -> int:
        return len(self._stored)

    def take(self, picture: NDArray[np.uint8]) -> Texture:
        """The texture of a picture [h, w, 3 or 4] uint8 sRGB, uploaded now if it is not there; counts one use more."""
        key = id(picture)
        held = self._stored.get(key)
        if held is not None and held.picture() is not picture:  # of a picture that is gone, whose id this one has
            self._stored[-held.name] = self._stored.pop(key)
        if key not in self._stored:
            levels = mip_levels(picture)
            size = sum(level.nbytes for level in levels)
            self._stored[key] = Texture(ref(picture), upload_texture(self._gl, levels), size, has_holes(picture))
            self.bytes += size
        texture = self._stored[key]
        self._stored.move_to_end(key)
        texture.uses += 1
        return texture

    def give_back(self, texture: Texture) -> None:
        """Count one use less; free unused textures whose pictures are gone, and the least recently used until the rest fit."""
        texture.uses -= 1
        for key, held in [(key, held) for key, held in self._stored.items() if held.uses == 0]:
            if self.fits and held.picture() is not None:
                continue
            unused = self._stored.pop(key)
            self._gl.glDeleteTextures(1, [unused.name])
            self.bytes -= unused.bytes

    @property
    def fits(self) -> bool:
        """Whether all of them together are within the bound."""
        return self.bytes <= self._max_bytes


def mip_levels(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], ...]:
    """Mip levels [h', w', 4] uint8 of a picture [h, w, 3 or 4] sRGB: area means at half the size, down to one pixel.

    Colours are roots of linear light, which a shader squares in half the time of decoding sRGB. The first level is the
    picture itself, or the largest that fits into `MAX_TEXTURE_PX`; row 0 is the lowest, as in OpenGL.
    """
    level: NDArray = cv2.flip(image, 0)
    if level.shape[2] == 3:
        level = cv2.cvtColor(np.asarray(cv2.LUT(level, _ROOT)), cv2.COLOR_RGB2RGBA)
    else:
        level = np.asarray(cv2.LUT(level, _ROOTS), np.uint8)
    shrink = min(1.0, MAX_TEXTURE_PX / max(level.shape[:2]))
    width, height = (max(1, round(shrink * level.shape[axis])) for axis in (1, 0))
    levels: list[NDArray[np.uint8]] = []
    while True:
        if level.shape[:2] != (height, width):
            level = cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(level, np.uint8))
        if width == height == 1:
            return tuple(levels)
        width, height = max(1, width // 2), max(1, height // 2)


def upload_texture(gl: ModuleType, levels: Sequence[NDArray[np.uint8]]) -> int:
    """A texture that repeats, with bilinear filtering within the nearest mip level."""
    texture = int(gl.glGenTextures(1))
    gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
    gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
    for i, level in enumerate(levels):
        height, width = level.shape[:2]
        form = (gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, level)
        gl.glTexImage2D(gl.GL_TEXTURE_2D, i, gl.GL_RGBA8, width, height, 0, *form)
    gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_MIN_FILTER, gl.GL_LINEAR_MIPMAP_NEAREST)
    gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_MAG_FILTER, gl.GL_LINEAR)
    gl.glBindTexture(gl.GL_TEXTURE_2D, 0)
    return texture


FLOAT_BYTES = INDEX_BYTES = 4

MAX_SHAPES = 512
"""Shapes on the GPU at most: 56 instances of each built-in category, and of tables."""

FEW_TRIANGLES, FEW_OPEN = 1000, 6000
"""Batches of up to so many triangles are drawn by the program variant that is fast per pixel, others by the other one.

The second is of scenes without light maps: a triangle has half of the values then.
"""


@dataclass(frozen=True)
class Uploaded:
    """One batch on the GPU; `bytes` without its texture."""

    vertex_array: int
    buffers: tuple[int, int]
    texture: Texture | None
    index_count: int
    top_count: int
    """The first so many indices belong to the shape's top (batches.py)."""
    planar: bool
    planar_top: bool
    matte: bool
    bytes: int
    positions: NDArray[np.float32]
    faces: NDArray[np.uint32]
    """Positions [V, 3] in the shape's frame, and faces [F, 3]: for what is decided before drawing. None of many faces."""

    @property
    def holes(self) -> bool:
        """Whether its texture has texels that are cut out of colour."""
        return self.texture is not None and self.texture.holes

    @property
    def few_triangles(self) -> bool:
        """Whether the variant for few triangles draws it fastest."""
        return self.index_count <= 3 * FEW_TRIANGLES


@dataclass(frozen=True, eq=False)
class UploadedShape:
    """A shape on the GPU: its batches, the corners [8, 3] of its bounding box, and whether its bodies are closed."""

    batches: tuple[Uploaded, ...]
    corners: Array
    closed: bool

    @cached_property
    def cover(self) -> Cover | None:
        """Its top, if that hides what is below it: if it has no holes, also no holes in its texture."""
        if any(batch.holes for batch in self.batches):
            return None
        tops = [batch.positions[batch.faces[: batch.top_count // 3]] for batch in self.batches]
        return find_cover(np.concatenate(tops))

    @property
    def bytes(self) -> int:
        """Size on the GPU without textures."""
        return sum(batch.bytes for batch in self.batches)


class ShapeStore:
    """Shapes on the GPU, by identity, as long as something else holds them.

    So what a scene alone has goes with the scene, and what the cache of assets keeps stays. The least recently used are
    freed when there are too many or they are too big.
    """

    def __init__(self, gl: ModuleType, max_shapes: int = MAX_SHAPES, max_bytes: int = 64 * 2**20) -> None:
        self._gl = gl
        self.textures = TextureStore(gl)
        self._max_shapes, self._max_bytes = max_shapes, max_bytes
        self._stored: OrderedDict[int, tuple[ref[Shape], UploadedShape]] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._stored)

    def __contains__(self, shape: Shape) -> bool:
        stored = self._stored.get(id(shape))
        return stored is not None and stored[0]() is shape

    def fetch(self, shape: Shape) -> UploadedShape:
        """The shape on the GPU, uploaded now if it is not there."""
        if shape in self:
            self._stored.move_to_end(id(shape))
            return self._stored[id(shape)][1]
        if id(shape) in self._stored:  # of a shape that is gone, whose id this one has
            self._free(id(shape))
        batches = tuple(_upload(self._gl, batch, self.textures) for batch in pack_shape(shape))
        corners = np.array(list(product(*bounds_of(shape.vertices).T)))
        uploaded = UploadedShape(batches, corners, shape.closed)
        self._stored[id(shape)] = (ref(shape), uploaded)
        self._bytes += uploaded.bytes
        return uploaded

    def trim(self, in_use: int) -> None:
        """Free shapes that are gone, and the least recently used until the bounds hold, but not the `in_use` fetched last."""
        for key in [key for key, (shape, _) in self._stored.items() if shape() is None]:
            self._free(key)
        while len(self._stored) > in_use:
            if len(self._stored) <= self._max_shapes and self._bytes <= self._max_bytes and self.textures.fits:
                return
            self._free(next(iter(self._stored)))

    def _free(self, key: int) -> None:
        _, uploaded = self._stored.pop(key)
        self._bytes -= uploaded.bytes
        for batch in uploaded.batches:
            self._gl.glDeleteVertexArrays(1, [batch.vertex_array])
            self._gl.glDeleteBuffers(2, batch.buffers)
            if batch.texture is not None:
                self.textures.give_back(batch.texture)


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
    top_count = 3 * batch.top_faces
    # Copies, so that the other columns are not kept.
    faces = batch.indices if len(batch.indices) <= FEW_TRIANGLES else batch.indices[:0]
    positions = batch.vertices[: len(batch.vertices) if len(faces) else 0, :3].copy()
    looks = batch.planar, batch.planar_top, batch.matte
    return Uploaded(vertex_array, buffers, texture, batch.indices.size, top_count, *looks, size, positions, faces)
