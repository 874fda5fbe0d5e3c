"""Sky visibility above a level, against closed forms, and elevations, against boxes whose elevations are known.

Light maps before they are uploaded, against geometry. Light maps: made once a scene, only those that the plan asks
for, and what colour is without them.
"""

import math
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import trimesh

from schemas.scene.scene import Placed
from schemas.scene.shape import Shape
from tests.workers.render.looks import (
    DOWN,
    FOUR,
    RASTER,
    WHITE_MATTE,
    brightness,
    pixel_of,
    white_floor,
    without,
)
from tests.workers.render.random_scenes import (
    APPEARANCE,
    camera,
    floor,
    orbit_and_mirror,
    random_things,
    shape_of,
    small,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import translation
from workers.render.raster.baking import (
    MAP_PX,
    SHADOW_PX,
    sky_visibility,
)
from workers.render.raster.light_maps import LightMaps


def test_a_long_wall_hides_what_its_form_factor_says():
    """A wall of height h at distance d, endless: half of 1 - d / sqrt(d^2 + h^2) of the sky."""
    top, nothing, step = np.zeros((120, 120), np.float32), np.zeros((120, 120), np.float32), 0.01
    top[:, 60:] = 0.06
    seen = sky_visibility(top, nothing, nothing, step)
    for steps in (2, 4, 8):
        d = (steps + 0.0) * step
        expected = 1.0 - 0.5 * (1.0 - d / math.hypot(d, 0.06))
        assert seen[60, 60 - steps] == pytest.approx(expected, abs=0.06)


def test_a_board_overhead_hides_the_sky_and_lets_light_in_from_the_sides():
    top, under = np.zeros((80, 80), np.float32), np.zeros((80, 80), np.float32)
    top[30:50, 30:50], under[30:50, 30:50] = 0.12, 0.1
    seen = sky_visibility(top, under, np.zeros_like(top), 0.01)
    assert 0.35 < seen[40, 40] < 0.7
    assert seen[40, 40] < seen[40, 52] < seen[40, 70] <= 1.0
    higher = sky_visibility(top + 0.3 * (top > 0), under + 0.3 * (top > 0), np.zeros_like(top), 0.01)
    assert higher[40, 40] > seen[40, 40]


BOX = shape_of(trimesh.creation.box((0.2, 0.2, 0.2)))


def things():
    return [floor(), Placed(2, BOX, translation(0.0, 0.0, 0.1)), Placed(3, BOX, translation(0.3, 0.1, 0.3))]


def counted(name: str):
    """A method of the light maps that does its work and counts its calls."""
    return mock.patch.object(LightMaps, name, autospec=True, side_effect=getattr(LightMaps, name))


def test_light_is_worked_out_once_a_scene_and_one_scene_is_kept(renderer):
    rng = np.random.default_rng(3)
    things, height = random_things(rng)
    views = orbit_and_mirror(rng, height)
    renderer.draw([floor()], APPEARANCE, views[0], *RASTER)
    with counted("_bake") as bake:
        for view in (*views, *views):
            renderer.draw(things, APPEARANCE, view, *RASTER)
    assert bake.call_count == 1
    assert 4 * (SHADOW_PX**2 + 2 * MAP_PX**2) <= 8 * 2**20
    renderer.draw(things, APPEARANCE, camera(small(64, 48), views[0].T_world_cam), *FOUR)
    assert renderer._colour_target.size == (64, 48)


def test_without_its_maps_a_scene_has_no_shadow_and_no_light_of_another_scene(renderer):
    rng = np.random.default_rng(2_000)
    things, height = random_things(rng)
    view, dark = orbit_and_mirror(rng, height)[0], without(RASTER, "light_maps")
    renderer.draw(things[:2], APPEARANCE, view, *RASTER)
    one = renderer.draw(things, APPEARANCE, view, *dark).rgb
    renderer.draw(things, APPEARANCE, view, *RASTER)
    two = renderer.draw(things, APPEARANCE, view, *dark).rgb
    assert np.array_equal(one, two)
    lit = renderer.draw(things, APPEARANCE, view, *RASTER).rgb
    assert one.astype(np.int64).sum() > lit.astype(np.int64).sum()
    neither = renderer.draw(things, APPEARANCE, view, *without(RASTER, "shadows", "ambient_occlusion")).rgb
    assert np.array_equal(one, neither)


@pytest.mark.parametrize("level_m", [0.0, 0.6], ids=["floor", "table"])
def test_without_shadows_a_point_behind_a_box_has_lamberts_brightness(renderer, level_m):
    """The key light alone, color 0.9 x cosine 0.8 on white, in the middle of what is the box's shadow; to 2 %."""
    box = shape_of(trimesh.creation.box((0.2, 0.2, 0.2)))
    (slab,) = shape_of(trimesh.creation.box((1.6, 1.2, 0.05))).parts
    matte = Shape((replace(slab, material=WHITE_MATTE),))
    table = [Placed(2, matte, translation(0.0, 0.0, level_m - 0.025))] if level_m else []
    things = [white_floor(), *table, Placed(3 if table else 2, box, translation(0.0, 0.0, level_m + 0.1))]
    view = camera(T=orbit_pose(np.array([0.0, 0.0, level_m]), 1.0, -np.pi / 2, 1.5))
    u, v = (int(c) for c in pixel_of(np.array([-0.16, 0.0, level_m]), view))
    shadowed = renderer.draw(things, DOWN, view, *RASTER)
    with counted("_cast") as cast:
        lit = renderer.draw(things, DOWN, view, *without(RASTER, "shadows"))
    assert cast.call_count == 0, "a shadow map was made"
    assert brightness(shadowed.rgb)[v, u] < 0.1 * 0.72
    assert brightness(lit.rgb)[v, u] == pytest.approx(0.9 * 0.8, rel=0.02)
    assert lit.depth_m.tobytes() == shadowed.depth_m.tobytes()
    assert lit.region.tobytes() == shadowed.region.tobytes()
