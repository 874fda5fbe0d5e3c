"""Textures on the GPU, by the identity of their pictures: scenes share those of floors and labels."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from weakref import ref

import cv2
import numpy as np
from numpy.typing import NDArray

from workers.geometry.srgb import SRGB_STEPS
from workers.geometry.texels import has_holes

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
