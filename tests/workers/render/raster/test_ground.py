"""What is known of a floor before it is drawn, against floors that are drawn whole."""

from unittest import mock

import numpy as np
import pytest
import trimesh

import workers.render.raster.gbuffer
from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Material, Part, Shape
from tests.workers.render.looks import FLAT, RASTER, without
from tests.workers.render.random_scenes import (
    APPEARANCE,
    EYE,
    WHITE,
    camera,
    floor,
    object_shape,
    orbit_and_mirror,
    procedural_things,
    quad,
    random_things,
    shape_of,
    small,
    stand,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import decode_srgb, encode_srgb
from workers.geometry.frames import invert, pose, transform, translation, uniform_rotation
from workers.render.raster.context import is_software
from workers.render.raster.draw_calls import RenderPass
from workers.render.raster.ground import Ground, find_ground, near_window

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


def test_a_floor_under_a_table_is_drawn_around_its_feet_alone(renderer):
    things, height = random_things(np.random.default_rng(3))
    view = orbit_and_mirror(np.random.default_rng(4), height)[0]
    left, top, right, bottom = known(renderer, things, view).window
    low = np.concatenate([transform(thing.T_world_shape, thing.shape.vertices) for thing in things[1:]])
    low = transform(invert(view.T_world_cam), low[low[:, 2] < 1e-9])
    k = view.intrinsics
    u, v = k.fx * low[:, 0] / low[:, 2] + k.cx, k.fy * low[:, 1] / low[:, 2] + k.cy
    feet = np.array([u.min(), v.min(), u.max(), v.max()])
    np.testing.assert_allclose([left, top, right, bottom], np.clip(feet, 0, [k.width, k.height] * 2), atol=4.0)


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


def test_where_the_depth_test_may_decide_everywhere_the_window_is_the_image(renderer):
    box = shape_of(trimesh.creation.box((0.2, 0.2, 0.2)))
    view = camera(small(40, 30), orbit_pose(np.zeros(3), 0.9, 0.0, 1.0))
    whole = (0, 0, 40, 30)
    assert window_of(renderer, Placed(3, box, EYE), view) != whole
    assert (
        window_of(renderer, Placed(3, box, EYE), camera(small(40, 30), orbit_pose(np.zeros(3), -0.9, 0.0, 1.0)))
        == whole
    )
    wide = shape_of(trimesh.creation.box((9.0, 9.0, 0.2)))
    assert window_of(renderer, Placed(3, wide, EYE), view) == whole, "it reaches behind the camera"
    left, top, right, bottom = window_of(renderer, Placed(3, box, translation(0.0, 0.0, 0.3)), view)
    assert left >= right or top >= bottom, "it hovers"
    narrow = small(40, 30, fx=400.0, fy=400.0)
    far = camera(narrow, orbit_pose(np.zeros(3), 0.9, 0.0, 6.0))
    left, top, right, bottom = window_of(renderer, Placed(3, box, translation(1.5, 1.5, 0.0)), far)
    assert left >= right or top >= bottom, "it is beside the image"


def test_a_floor_that_varies_or_does_not_fill_the_image_is_drawn(renderer):
    above, level = camera(T=orbit_pose(np.zeros(3), 0.8, 0.3, 2.0)), camera(T=orbit_pose(np.zeros(3), 0.05, 0.3, 2.0))
    assert known(renderer, [floor()], above).cleared is not None
    assert known(renderer, [floor()], level) is None
    assert known(renderer, [floor(), floor()], above) is None
    assert known(renderer, [floor()], above, without(FLAT, "floor")) is None
    (part,) = floor().shape.parts
    texture = np.full((4, 4, 3), 90, np.uint8)
    uv = frozen_array(part.vertices[:, :2] * 3)
    for material, coords in ((Material(roughness=0.3), None), (Material(roughness=0.9, texture=texture), uv)):
        varied = Placed(1, Shape((Part("p", part.vertices, part.faces, material, None, coords),)), EYE)
        assert known(renderer, [varied], above).cleared is None


def test_a_sheet_that_hovers_by_less_than_the_bias_is_hidden_as_by_a_floor_that_is_drawn(renderer):
    view = camera(small(60, 50), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    hidden = []
    for height_m in (0.0, 5e-6, 2e-5, 1e-4, 1e-3, 5e-3):
        sheet = quad([[-0.3, -0.3, 0], [0.3, -0.3, 0], [0.3, 0.3, 0], [-0.3, 0.3, 0]])
        things = [floor(), Placed(3, sheet, translation(0.0, 0.0, height_m))]
        assert known(renderer, things, view).cleared is not None
        seen = renderer.draw(things, APPEARANCE, view, *FLAT)
        with mock.patch.object(workers.render.raster.gbuffer, "find_ground", return_value=None):
            drawn = renderer.draw(things, APPEARANCE, view, *FLAT)
        np.testing.assert_array_equal(seen.region, drawn.region)
        hidden.append(bool((seen.region == 1).all()))
    assert hidden[0] and hidden[1] and not hidden[-1]


def test_from_below_a_floor_has_the_light_of_the_sky_alone(renderer):
    view = camera(small(20, 16), orbit_pose(np.zeros(3), -1.2, 0.4, 2.0))
    rgb = renderer.draw([floor()], APPEARANCE, view, *FLAT).rgb
    ambient = np.array(APPEARANCE.ambient)
    expected = encode_srgb((decode_srgb(np.array(0.7)) + 0.04) * ambient)
    assert np.abs(rgb / 255.0 - expected).max() * 255.0 <= 0.7


def test_a_slanted_floor_of_one_colour_has_the_light_of_its_own_plane(renderer):
    """It is not level in its own frame, so its colour is not found before it is drawn, and keeps its weak highlight."""
    matte, view = Material(roughness=0.9), camera(small(20, 16), orbit_pose(np.zeros(3), 1.2, 0.4, 2.0))
    h = 4.0
    slanted = quad([[-h, -h, -h], [h, -h, h], [h, h, h], [-h, h, -h]], material=matte)
    turned = Placed(
        1, floor().shape, np.array([[1, 0, -1, 0], [0, 2**0.5, 0, 0], [1, 0, 1, 0], [0, 0, 0, 2**0.5]]) / 2**0.5
    )
    look = Appearance((0.1, 0.1, 0.1), APPEARANCE.lights, WHITE.background)
    seen, same = (renderer.draw([one], look, view, *FLAT) for one in (Placed(1, slanted, EYE), turned))
    both = (seen.region == 1) & (same.region == 1)
    assert both.sum() > 100
    assert np.abs(seen.rgb.astype(int) - same.rgb)[both].max() <= 3
    assert seen.rgb[both].min() > 60
