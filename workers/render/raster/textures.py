"""Textures on the GPU, by the identity of their pictures: floors and labels share them across scenes."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import NDArray

from workers.geometry.srgb import SRGB_STEPS
from workers.geometry.texels import has_holes

MAX_TEXTURE_PX = 2048
"""A larger texture is made smaller before it is uploaded: at most this many pixels wide and high."""


_ROOTS = np.stack([np.rint(255.0 * np.sqrt(SRGB_STEPS))] * 3 + [np.arange(256.0)], axis=-1).astype(np.uint8)[:, None, :]
"""[256, 1, 4] uint8: the root of linear light of each sRGB code, in 255ths; alpha as it is."""


@dataclass(eq=False)
class Texture:
    """A picture on the GPU, and how many batches draw with it. The picture is held, so that its id stays its own."""

    picture: NDArray[np.uint8]
    name: int
    bytes: int
    holes: bool
    """Some texels are cut out of colour."""
    uses: int = 0


class TextureStore:
    """Textures in use, and beside them the last that were, while they all fit into `max_bytes`."""

    def __init__(self, gl: ModuleType, max_bytes: int = 32 * 2**20) -> None:
        self._gl, self._max_bytes = gl, max_bytes
        self._stored: OrderedDict[int, Texture] = OrderedDict()
        self.bytes = 0
        self._white: int | None = None

    @property
    def white(self) -> int:
        """A texture that multiplies by one everywhere, for what has none of its own."""
        if self._white is None:
            self._white = upload_texture(self._gl, mip_levels(np.full((1, 1, 3), 255, np.uint8)))
        return self._white

    def __len__(self) -> int:
        return len(self._stored)

    def take(self, picture: NDArray[np.uint8]) -> Texture:
        """The texture of a picture [h, w, 3 or 4] uint8 sRGB, uploaded now if it is not there, with one use more."""
        key = id(picture)
        if key not in self._stored:
            levels = mip_levels(picture)
            size = sum(level.nbytes for level in levels)
            self._stored[key] = Texture(picture, upload_texture(self._gl, levels), size, has_holes(picture))
            self.bytes += size
        texture = self._stored[key]
        self._stored.move_to_end(key)
        texture.uses += 1
        return texture

    def give_back(self, texture: Texture) -> None:
        """One use less. Of those without any, the longest unused are freed until the rest fit."""
        texture.uses -= 1
        for key in [key for key, held in self._stored.items() if held.uses == 0]:
            if self.fit:
                return
            self._free(self._stored.pop(key))

    @property
    def fit(self) -> bool:
        """Whether all of them together are within the bound."""
        return self.bytes <= self._max_bytes

    def clear(self) -> None:
        """Free everything; nothing may be in use."""
        while self._stored:
            self._free(self._stored.popitem()[1])
        if self._white is not None:
            self._gl.glDeleteTextures(1, [self._white])
            self._white = None

    def _free(self, texture: Texture) -> None:
        self._gl.glDeleteTextures(1, [texture.name])
        self.bytes -= texture.bytes


def mip_levels(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], ...]:
    """A picture [h, w, 3 or 4] sRGB and its copies at half the size down to one pixel, [h', w', 4] uint8, area means.

    Colours are roots of linear light, which a shader squares: half the time of decoding sRGB for each texel. The first is
    the picture itself, or the largest that fits into `MAX_TEXTURE_PX`; row 0 is the lowest, OpenGL's.
    """
    level: NDArray = np.ascontiguousarray(image[::-1])
    if level.shape[2] == 3:
        level = cv2.cvtColor(level, cv2.COLOR_RGB2RGBA)
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
    """A texture, repeated, interpolated between its pixels; of its levels the nearest is read."""
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
