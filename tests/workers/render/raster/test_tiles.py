"""The part of the pixel grid on which a thing is counted, what covers all of the image, and what is seen steeply."""

import numpy as np
import trimesh

from schemas.base import frozen_array
from schemas.scene.shape import Part, Shape
from schemas.scene.view import Intrinsics
from tests.workers.render.random_scenes import FLOOR_HALF_M, floor, shape_of
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import invert, translation
from workers.render.raster.ground import TILE_PX, fills_image, is_steep, tiles, window
from workers.render.raster.shaders import GRAZING

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


def test_a_floor_that_fills_the_image_is_met_by_the_ray_of_every_pixel():
    """True for nearly all views that meet it in every pixel; never for one that misses it somewhere."""
    rng, agreed = np.random.default_rng(5), []
    shape = floor().shape
    for _ in range(300):
        T_world_cam = orbit_pose(rng.normal(0.0, 12.0, 3) * [1, 1, 0], rng.uniform(-1.5, 1.5), rng.uniform(-3, 3), 3.0)
        x, y = np.meshgrid(np.linspace(0, K.width, 41), np.linspace(0, K.height, 41))
        rays = np.stack([(x - K.cx) / K.fx, (y - K.cy) / K.fy, np.ones_like(x)], -1) @ T_world_cam[:3, :3].T
        away = -T_world_cam[2, 3] / rays[..., 2]
        met = T_world_cam[:2, 3] + away[..., None] * rays[..., :2]
        every = bool((away > 0.05).all() and (abs(met) < FLOOR_HALF_M).all())
        fills = fills_image(shape, invert(T_world_cam), K)
        assert every or not fills
        agreed.append((every, fills))
    every, fills = np.array(agreed).T
    assert 30 < fills.sum() < 270
    assert fills.sum() >= 0.95 * every.sum()


def test_only_a_rectangle_of_two_triangles_fills_an_image():
    corners, above = [[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], invert(orbit_pose(np.zeros(3), 1.0, 0.0, 1.0))
    whole = np.array(corners, float)
    tilted, slanted = whole.copy(), whole.copy()
    tilted[2:, 2] = slanted[2, 0] = 10.0
    halves, twice = [[0, 1, 2], [0, 2, 3]], [[0, 1, 2], [1, 2, 3]]
    cases = [(whole, halves, True), (whole, twice, False), (tilted, halves, False), (slanted, halves, False)]
    cases += [(whole, halves[:1] * 2, False), (whole, halves[:1], False), (0.01 * whole, halves, False)]
    for vertices, faces, fills in cases:
        shape = Shape((Part("p", frozen_array(vertices), np.array(faces, np.int32)),))
        assert fills_image(shape, above, K) == fills


def cosines(T_world_cam: np.ndarray) -> np.ndarray:
    """Of the angle between the level's normal and the ray of each of 41 x 41 points of the image, with its sign."""
    x, y = np.meshgrid(np.linspace(0, K.width, 41), np.linspace(0, K.height, 41))
    rays = np.stack([(x - K.cx) / K.fx, (y - K.cy) / K.fy, np.ones_like(x)], -1)
    return (rays @ T_world_cam[:3, :3].T)[..., 2] / np.linalg.norm(rays, axis=-1)


def test_a_level_that_is_seen_steeply_is_met_by_every_ray_above_the_grazing_angle():
    """True for nearly all views that meet it so, but for those at the limit; never for one that does not somewhere."""
    rng, agreed = np.random.default_rng(6), []
    for turn in range(400):
        inclination = (
            rng.uniform(-1.5, 1.5) if turn % 2 else rng.uniform(0.36, 0.42)
        )  # the highest rays are level there
        T_world_cam = orbit_pose(rng.normal(0.0, 3.0, 3), inclination, rng.uniform(-3, 3), 3.0)
        found = cosines(T_world_cam)
        every = bool((found > GRAZING).all() or (found < -GRAZING).all())
        steep = is_steep(floor().shape, invert(T_world_cam), K)
        assert every or not steep
        agreed.append((every, steep))
    every, steep = np.array(agreed).T
    assert 100 < steep.sum() < 350
    assert steep[1::2].sum() >= 0.9 * every[1::2].sum()


def test_only_what_lies_on_one_level_is_seen_steeply():
    above = invert(orbit_pose(np.zeros(3), 1.0, 0.0, 1.0))
    assert not is_steep(shape_of(trimesh.creation.box((9.0, 9.0, 1e-6))), above, K)
    assert is_steep(floor().shape, above, K)
