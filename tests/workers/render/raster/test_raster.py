"""The raster tier: what light does, against geometry; and that labels do not know of it."""

import hashlib
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.job.render import Render
from schemas.scene.appearance import Appearance, Light
from schemas.scene.scene import Placed
from schemas.scene.shape import Material, Part, Shape
from tests.workers.render.random_scenes import (
    APPEARANCE,
    EYE,
    camera,
    facing,
    floor,
    orbit_and_mirror,
    procedural_things,
    quad,
    random_things,
    shape_of,
    small,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import invert, translation
from workers.geometry.srgb import decode_srgb
from workers.render.raster.baking import MAP_PX, SHADOW_PX
from workers.render.raster.light_maps import MAP_BYTES

FLAT, RASTER, FOUR = Render(tier="flat"), Render(tier="raster"), Render(tier="raster", samples=4)
BLACK = (0.0, 0.0, 0.0)
DOWN = Appearance(BLACK, (Light(frozen_array([0.6, 0.0, 0.8]), (0.9, 0.9, 0.9)),), BLACK)
"""One light from +x, 53 degrees above the horizon, and nothing else."""


def brightness(rgb):
    return decode_srgb(rgb[..., 1] / 255.0)


@pytest.mark.parametrize("render", [RASTER, FOUR])
def test_labels_are_the_flat_tiers_to_the_byte(renderer, render):
    for seed in range(12):
        rng = np.random.default_rng(900 + seed)
        things, height = procedural_things(rng) if seed % 2 else random_things(rng)
        for view in orbit_and_mirror(rng, height):
            flat, raster = (renderer.draw(things, APPEARANCE, view, one) for one in (FLAT, render))
            assert flat.depth_m.tobytes() == raster.depth_m.tobytes()
            assert flat.region.tobytes() == raster.region.tobytes()
            assert not np.array_equal(flat.rgb, raster.rgb)


def test_a_white_plane_under_one_light_is_as_bright_as_lambert_says(renderer):
    """No light but the key: color x albedo x cosine, to 2 %, below the knee of the tone curve."""
    (part,) = floor().shape.parts
    white = Shape((Part("p", part.vertices, part.faces, Material((1.0, 1.0, 1.0, 1.0), roughness=1.0)),))
    view = camera(small(33, 33), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    for angle in (0.0, 0.4, 0.8, 1.1):
        light = Light(frozen_array([np.sin(angle), 0.0, np.cos(angle)]), (0.75, 0.75, 0.75))
        seen = renderer.draw([Placed(1, white, EYE)], Appearance(BLACK, (light,), BLACK), view, RASTER)
        assert brightness(seen.rgb)[16, 16] == pytest.approx(0.75 * np.cos(angle), rel=0.02), f"at {angle} rad"


def test_too_much_light_bends_towards_white_and_keeps_its_order(renderer):
    view, seen = camera(small(9, 9), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0)), []
    for level in (0.5, 1.0, 1.5, 3.0, 10.0):
        look = Appearance(BLACK, (Light(frozen_array([0.0, 0.0, 1.0]), (level,) * 3),), BLACK)
        seen.append(int(renderer.draw([floor()], look, view, RASTER).rgb[4, 4, 1]))
    assert seen == sorted(set(seen)) and seen[-1] <= 255


def pixel_of(point, view):
    """(u, v) of a point of the world."""
    x, y, z = (invert(view.T_world_cam) @ np.append(point, 1.0))[:3]
    k = view.intrinsics
    return k.fx * x / z + k.cx, k.fy * y / z + k.cy


@pytest.mark.parametrize("level", ["floor", "table"])
def test_a_boxes_shadow_ends_where_geometry_says(renderer, level):
    """A box 0.2 high throws a shadow 0.2 / tan of the light's elevation long: its end, within 2 px of the image.

    On the floor as a table (region 2), and on a table as an object.
    """
    height = 0.2
    box = shape_of(trimesh.creation.box((0.2, 0.2, height)))
    slab = shape_of(trimesh.creation.box((1.6, 1.2, 0.05)))
    ground = 0.0 if level == "floor" else 0.6
    things = [floor(), Placed(2, box, translation(0.0, 0.0, height / 2))]
    if level == "table":
        things = [
            floor(),
            Placed(2, slab, translation(0, 0, 0.575)),
            Placed(3, box, translation(0.0, 0.0, 0.6 + height / 2)),
        ]
    view = camera(T=orbit_pose(np.array([0.0, 0.0, ground]), 1.0, -np.pi / 2, 1.5))
    seen = brightness(renderer.draw(things, DOWN, view, RASTER).rgb)
    end = -0.1 - height * 0.6 / 0.8
    profile = []
    for x in np.linspace(-0.12, -0.40, 281):
        u, v = pixel_of(np.array([x, 0.0, ground]), view)
        profile.append((x, u, seen[int(v), int(u)]))
    lit = profile[-1][2]
    assert lit > 0.1
    assert profile[10][2] < 0.1 * lit, "in the middle of the shadow there is hardly any light"
    edge = next(u for _, u, value in profile if value > 0.5 * lit)
    assert edge == pytest.approx(pixel_of(np.array([end, 0.0, ground]), view)[0], abs=2.0)


def test_the_lit_side_of_a_thing_does_not_shade_itself(renderer):
    """A fine sphere: wherever the light comes from above 20 degrees to the face, it has Lambert's brightness."""
    ball = trimesh.creation.icosphere(5, 0.12)
    things = [floor(), Placed(3, shape_of(ball), translation(0.0, 0.0, 0.5))]
    view = camera(T=orbit_pose(np.array([0.0, 0.0, 0.5]), 0.8, 0.2, 1.0))
    seen = renderer.draw(things, DOWN, view, RASTER)
    k = view.intrinsics
    v, u = np.nonzero(seen.region == 3)
    z = seen.depth_m[v, u]
    points = np.stack([(u + 0.5 - k.cx) / k.fx * z, (v + 0.5 - k.cy) / k.fy * z, z, np.ones_like(z)])
    normals = ((view.T_world_cam @ points)[:3].T - [0.0, 0.0, 0.5]) / 0.12
    cosine = normals @ [0.6, 0.0, 0.8]
    chosen = cosine > np.sin(np.radians(20.0))
    share = brightness(seen.rgb)[v, u][chosen] / (0.9 * decode_srgb(np.array(0.7)) * cosine[chosen])
    assert np.percentile(share, 1) > 0.85


def test_where_a_thing_stands_the_table_is_darker_without_any_light_but_the_sky(renderer):
    """Beside a wall the sky is half hidden; half a metre from it hardly."""
    wall = shape_of(trimesh.creation.box((0.02, 0.5, 0.3)))
    slab = shape_of(trimesh.creation.box((2.0, 2.0, 0.05)))
    things = [floor(), Placed(2, slab, translation(0, 0, 0.575)), Placed(3, wall, translation(0, 0, 0.75))]
    dark = Light(frozen_array([0.0, 0.0, 1.0]), BLACK)
    view = camera(T=orbit_pose(np.array([0.0, 0.0, 0.6]), 0.9, -0.3, 1.5))
    seen = brightness(renderer.draw(things, Appearance((0.5,) * 3, (dark,), BLACK), view, RASTER).rgb)
    at = {x: seen[tuple(int(c) for c in pixel_of(np.array([x, 0.0, 0.6]), view)[::-1])] for x in (0.03, 0.1, 0.5)}
    assert 0.4 < at[0.03] / at[0.5] < 0.75
    assert at[0.03] < at[0.1] < at[0.5]


@pytest.mark.parametrize("render", [RASTER, FOUR])
def test_a_slanted_edge_is_smooth_and_its_labels_are_not_touched(renderer, render):
    """White on black: along each row brightness never falls, and every third row has something in between."""
    slope = 0.3
    shape = quad(
        [[0.0, -2.0, 2.0], [3.0, -2.0, 2.0], [3.0, 2.0, 2.0], [slope * 4, 2.0, 2.0]], material=Material((1, 1, 1, 1))
    )
    white = Appearance((0.7,) * 3, (), BLACK, (0.7,) * 3)
    views = [
        renderer.draw([Placed(3, shape, translation(-0.6, 0, 0))], white, camera(small(80, 80)), one)
        for one in (FLAT, render)
    ]
    assert views[0].region.tobytes() == views[1].region.tobytes()
    rows = views[1].rgb[4:-4, :, 1].astype(int)
    assert (np.diff(rows, axis=1)[:, 4:-4] >= -1).all()
    top = rows.max()
    between = ((rows > 0.1 * top) & (rows < 0.9 * top)).any(axis=1)
    assert between.mean() > 0.5
    flat_rows = views[0].rgb[4:-4, :, 1].astype(int)
    assert not ((flat_rows > 0.1 * flat_rows.max()) & (flat_rows < 0.9 * flat_rows.max())).any()


@pytest.mark.parametrize("render", [RASTER, FOUR])
def test_through_a_hole_in_a_texture_one_sees_what_is_behind_and_labels_are_solid(renderer, render):
    texture = np.full((8, 8, 4), 255, np.uint8)
    texture[:, :4, 3] = 0
    (part,) = facing(2.0, 1.0).parts
    uv = frozen_array([[0, 0], [1, 0], [1, 1], [0, 1]])
    red = Material((1.0, 0.0, 0.0, 1.0), texture=texture)
    front = Shape((Part("front", part.vertices, part.faces, red, uv=uv),))
    behind = quad([[-9, -9, 4], [9, -9, 4], [9, 9, 4], [-9, 9, 4]], material=Material((0.0, 0.0, 1.0, 1.0)))
    look = Appearance((0.7,) * 3, (), BLACK, (0.7,) * 3)
    things = [Placed(2, behind, EYE), Placed(3, front, EYE)]
    seen = renderer.draw(things, look, camera(small(40, 40)), render)
    left, right = seen.rgb[20, 13], seen.rgb[20, 27]
    assert left[2] > 150 > 100 > left[0]
    assert right[0] > 150 > 100 > right[2]
    assert (seen.region[11:29, 11:29] == 3).all()
    assert np.abs(seen.depth_m[11:29, 11:29] - 2.0).max() < 1e-5


def test_drawing_again_gives_the_same_bytes_also_in_another_process(renderer):
    code = (
        "import hashlib, numpy as np\n"
        "from schemas.job.render import Render\n"
        "from tests.workers.render.random_scenes import *\n"
        "from workers.render.raster.gbuffer import shared_renderer\n"
        "rng = np.random.default_rng(31)\n"
        "things, height = procedural_things(rng)\n"
        "view = orbit_and_mirror(rng, height)[1]\n"
        "for samples in (1, 4):\n"
        "    rgb = shared_renderer().draw(things, APPEARANCE, view, Render(tier='raster', samples=samples)).rgb\n"
        "    print(hashlib.sha256(rgb.tobytes()).hexdigest())\n"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    rng = np.random.default_rng(31)
    things, height = procedural_things(rng)
    view = orbit_and_mirror(rng, height)[1]
    for _ in range(2):
        mine = ""
        for render in (RASTER, FOUR):
            mine += hashlib.sha256(renderer.draw(things, APPEARANCE, view, render).rgb.tobytes()).hexdigest() + "\n"
        assert mine == other
        renderer.draw(random_things(np.random.default_rng(5))[0], APPEARANCE, view, FOUR)


def test_light_is_worked_out_once_a_scene_and_one_scene_is_kept(renderer):
    rng = np.random.default_rng(3)
    things, height = random_things(rng)
    views = orbit_and_mirror(rng, height)
    renderer.draw([floor()], APPEARANCE, views[0], RASTER)
    made = renderer._lit().bakes
    for view in (*views, *views):
        renderer.draw(things, APPEARANCE, view, RASTER)
    assert renderer._lit().bakes == made + 1
    assert 4 * (SHADOW_PX**2 + 2 * MAP_PX**2) <= MAP_BYTES <= 8 * 2**20
    renderer.draw(things, APPEARANCE, camera(small(64, 48), views[0].T_world_cam), FOUR)
    assert renderer._colour().size == (64, 48)
