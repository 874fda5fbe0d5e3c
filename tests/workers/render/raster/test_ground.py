"""The part of the pixel grid on which a thing is counted, what covers all of the image, and what is seen steeply.

What is known of a floor before it is drawn, against floors that are drawn whole.
"""

from unittest import mock

import numpy as np
import pytest
import trimesh

import workers.render.raster.gbuffer
from schemas.scene.scene import Placed
from schemas.scene.view import Intrinsics
from tests.workers.render.looks import FLAT, RASTER, without
from tests.workers.render.random_scenes import (
    APPEARANCE,
    FLOOR_HALF_M,
    camera,
    floor,
    object_shape,
    orbit_and_mirror,
    procedural_things,
    random_things,
    shape_of,
    small,
    stand,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import invert, pose, transform, translation, uniform_rotation
from workers.render.raster.context import is_software
from workers.render.raster.draw_calls import RenderPass
from workers.render.raster.ground import TILE_PX, Ground, fills_image, find_ground, is_steep, near_window, tiles
from workers.render.raster.shaders import GRAZING

K = Intrinsics(width=100, height=80, fx=100.0, fy=100.0, cx=50.0, cy=40.0)


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


GPU_DIVISION = 2.0**-21
"""Relative error of z that a GPU draws: GLSL allows a division 2.5 units in the last place, and fused sums another one or two."""

LOOKS = {"flat": FLAT, "labels alone": without(FLAT, "rgb"), "raster": RASTER}


def scene(seed: int):
    """Things and three views, one from below: a table with objects, and two objects on the floor, in it or just above it."""
    rng = np.random.default_rng(9_000 + seed)
    things, height = procedural_things(rng) if seed % 2 else random_things(rng)
    for depth_m in (rng.choice([-2e-5, -5e-6, -1e-6]), rng.choice([0.0, 1e-6, 1e-5, 1e-4, 1e-3, 0.02])):
        spot = rng.uniform(-0.9, 0.9, 2)
        T = stand(shape := object_shape(rng), uniform_rotation(rng), spot, -depth_m)
        things.append(Placed(len(things) + 1, shape, T))
    below = camera(T=orbit_pose(np.zeros(3), -rng.uniform(0.7, 1.5), rng.uniform(-3, 3), 2.5))
    return tuple(things), (*orbit_and_mirror(rng, height), below)


def known(renderer, things, view, look=FLAT) -> Ground | None:
    """What the renderer finds of the floor of a view."""
    found = []

    def find(*args):
        found.append(find_ground(*args))
        return found[-1]

    with mock.patch.object(workers.render.raster.gbuffer, "find_ground", find):
        renderer.draw(things, APPEARANCE, view, *look)
    return found[0]


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
def test_a_known_floor_is_seen_to_the_same_bytes(renderer, look):
    shares, met = [], 0
    for seed in range(12):
        things, views = scene(seed)
        for view in views:
            ground = known(renderer, things, view, look)
            assert ground is not None
            left, top, right, bottom = ground.window
            shares.append((right - left) * (bottom - top) / (view.intrinsics.width * view.intrinsics.height))
            seen = renderer.draw(things, APPEARANCE, view, *look)
            with mock.patch.object(workers.render.raster.gbuffer, "find_ground", return_value=None):
                drawn = renderer.draw(things, APPEARANCE, view, *look)
            for kind in ("rgb", "depth_m", "region"):
                a, b = getattr(seen, kind), getattr(drawn, kind)
                if kind == "depth_m" and not is_software(renderer.name):
                    np.testing.assert_allclose(a, b, rtol=GPU_DIVISION)
                    continue
                assert (a is None and b is None) or a.tobytes() == b.tobytes(), (seed, kind)
            met += bool((seen.region == things[-1].region_id).any())
            assert view is not views[2] or (seen.region == 1).mean() > 0.9
    assert met >= 8, "what lies on the floor is seen in many scenes"
    if look is RASTER:
        assert set(shares) == {1.0}
    else:
        assert 0.02 < np.median(shares) < 0.6


def window_of(renderer, thing: Placed, view, up_m: float = 0.0):
    """The window about one thing on a floor that is moved up by `up_m`."""
    passed = RenderPass(APPEARANCE, view.intrinsics, invert(view.T_world_cam), FLAT[1], True, False)
    ground = Placed(1, floor().shape, translation(0.0, 0.0, up_m))
    return near_window(ground, [thing], passed, 2, renderer._shapes.fetch)


def test_the_window_holds_all_that_is_low(renderer):
    """Points drawn on the surfaces of bodies that stick in a floor, also in one that is not the world's."""
    rng, inside = np.random.default_rng(8), 0
    for turn in range(40):
        up_m = (0.0, 0.35)[turn % 2]
        mesh = trimesh.creation.box(rng.uniform(0.05, 0.6, 3))
        T = pose(uniform_rotation(rng), np.array([*rng.uniform(-0.5, 0.5, 2), up_m]))
        view = camera(small(200, 160), orbit_pose(np.array([0.0, 0.0, up_m]), rng.uniform(0.6, 1.5), turn, 2.0))
        left, top, right, bottom = window_of(renderer, Placed(3, shape_of(mesh), T), view, up_m)
        points = transform(T, trimesh.sample.sample_surface(mesh, 4000, seed=turn)[0])
        low = transform(invert(view.T_world_cam), points[points[:, 2] < up_m + 1e-4])
        k = view.intrinsics
        u, v = k.fx * low[:, 0] / low[:, 2] + k.cx, k.fy * low[:, 1] / low[:, 2] + k.cy
        seen = (u > 0) & (u < k.width) & (v > 0) & (v < k.height)
        assert ((u >= left) & (u <= right) & (v >= top) & (v <= bottom))[seen].all()
        inside += seen.sum()
    assert inside > 10_000
