"""Textures before they are uploaded.

The store of shapes on the GPU: what was drawn last stays, and the rest goes where it is too much.
"""

import numpy as np
import trimesh

from tests.kit.shapes import shape_of
from workers.render.raster.buffers import ShapeStore, TextureStore, mip_levels


def roots_of(image: np.ndarray) -> np.ndarray:
    """255 times the root of linear light of sRGB codes (IEC 61966-2-1)."""
    encoded = image / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.asarray(255.0 * np.sqrt(linear))


def test_levels_halve_down_to_one_pixel_and_keep_the_mean():
    image = np.random.default_rng(0).integers(0, 256, (64, 32, 3), dtype=np.uint8)
    levels = mip_levels(image)
    assert [level.shape for level in levels] == [(64 >> i, max(1, 32 >> i), 4) for i in range(7)]
    for level in levels:
        assert np.abs(level[..., :3].mean(axis=(0, 1)) - roots_of(image).mean(axis=(0, 1))).max() < 2.0
        assert (level[..., 3] == 255).all()


class Driver:
    """Counts what is made and what is freed."""

    def __init__(self) -> None:
        self.made = 0
        self.freed: list[int] = []

    def glGenTextures(self, count: int) -> int:
        self.made += 1
        return self.made

    def glDeleteTextures(self, count: int, names: list[int]) -> None:
        self.freed += names

    def __getattr__(self, name: str) -> object:
        return 0 if name.isupper() or name.startswith("GL_") else lambda *arguments: None


def test_a_picture_is_uploaded_once_and_kept_while_there_is_room():
    driver = Driver()
    store = TextureStore(driver, max_bytes=3 * 4 * 341)  # three pictures of 16 x 16 with their levels
    pictures = [np.full((16, 16, 3), n, np.uint8) for n in range(4)]
    first = store.take(pictures[0])
    assert store.take(pictures[0]) is first and driver.made == 1
    store.give_back(first)
    store.give_back(first)
    assert store.take(pictures[0]) is first, "kept without a use"
    store.give_back(first)
    others = [store.take(picture) for picture in pictures[1:]]
    assert not store.fits and driver.freed == []
    store.give_back(others[0])
    assert driver.freed == [first.name], "the longest unused goes first"
    assert store.fits and len(store) == 3


def test_the_least_recently_used_shapes_are_freed_and_those_in_use_stay(renderer):
    store = ShapeStore(renderer._gl, max_shapes=2)
    shapes = [shape_of(trimesh.creation.box((0.1 * k, 0.1, 0.1))) for k in range(1, 5)]
    uploaded = [store.fetch(shape) for shape in shapes]
    assert store.fetch(shapes[0]) is uploaded[0], "not uploaded again, and used last from now on"
    store.trim(3)
    assert [shape in store for shape in shapes] == [True, False, True, True]
    store.trim(1)
    assert [shape in store for shape in shapes] == [True, False, False, True]
