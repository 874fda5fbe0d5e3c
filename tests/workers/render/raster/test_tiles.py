"""The part of the pixel grid on which a thing is counted."""

import numpy as np
import trimesh

from schemas.scene.camera import Intrinsics
from tests.workers.render.random_scenes import shape_of
from workers.geometry.frames import translation
from workers.render.raster.tiles import TILE_PX, tiles, window

K = Intrinsics(width=100, height=80, fx=100.0, fy=100.0, cx=50.0, cy=40.0)


def box_at(x: float, y: float, z: float, half: float = 0.1) -> np.ndarray:
    return np.array([[x + i * half, y + j * half, z] for i in (-1, 1) for j in (-1, 1)])


def test_the_window_is_the_projected_bounding_box_in_whole_pixels():
    assert window(box_at(0.0, 0.0, 1.0), K) == (40, 30, 60, 50)
    assert window(box_at(0.003, 0.0, 1.0), K) == (40, 30, 61, 50)


def test_the_window_reaches_one_image_beyond_the_image_and_no_further():
    assert window(box_at(0.9, 0.0, 1.0), K) == (130, 30, 150, 50)
    assert window(box_at(0.0, 0.0, 0.06, half=9.0), K) == (-100, -80, 200, 160)
    assert window(box_at(50.0, 0.0, 1.0), K)[0::2] == (200, 200), "too far to the right: empty"


def test_what_reaches_behind_the_camera_gets_all_of_it_and_what_is_behind_nothing():
    assert window(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]), K) == (-100, -80, 200, 160)
    assert window(box_at(0.0, 0.0, -1.0), K) == (0, 0, 0, 0)


def test_tiles_cover_the_window_once_on_the_same_pixel_grid():
    k = Intrinsics(width=700, height=300, fx=350.5, fy=351.5, cx=340.25, cy=160.75)
    seen = np.zeros((900, 2100), int)
    for tile in tiles(shape_of(trimesh.creation.box((3.0, 2.0, 0.1))), translation(0, 0, 1.5), k):
        assert max(tile.width, tile.height) <= TILE_PX
        assert (tile.fx, tile.fy) == (k.fx, k.fy)
        x, y = k.cx - tile.cx, k.cy - tile.cy
        assert x == round(x) and y == round(y)
        seen[round(y) + 300 : round(y) + 300 + tile.height, round(x) + 700 : round(x) + 700 + tile.width] += 1
    # The box's nearer side, 1.45 m away, has the larger image; the surroundings begin at (-700, -300).
    half = np.array([1.5 * k.fx, 1.0 * k.fy]) / 1.45
    left, top = np.floor(np.array([k.cx, k.cy]) - half).astype(int) + np.array([700, 300])
    right, bottom = np.ceil(np.array([k.cx, k.cy]) + half).astype(int) + np.array([700, 300])
    expected = np.zeros_like(seen)
    expected[top:bottom, left:right] = 1
    np.testing.assert_array_equal(seen, expected)
