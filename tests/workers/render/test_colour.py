"""Colour of the raster tiers against light, albedo and geometry; what each effect adds, and that no label depends on it."""

import math
from collections import Counter
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import trimesh

import workers.render.raster.gbuffer
from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from tests.workers.render.random_scenes import (
    APPEARANCE,
    BLACK,
    DOWN,
    EYE,
    FLAT,
    FOUR,
    RASTER,
    WHITE,
    WHITE_MATTE,
    Look,
    brightness,
    camera,
    facing,
    floor,
    forcing,
    orbit_and_mirror,
    part_of,
    pixel_of,
    procedural_things,
    quad,
    random_things,
    shape_of,
    small,
    white_floor,
    with_material,
    without,
)
from workers.assets.look.appearance import STUDIO_LIGHTS
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import decode_srgb, encode_srgb
from workers.geometry.frames import translation
from workers.render.raster.antialiasing import find_edges
from workers.render.raster.baking import MAP_PX, SHADOW_PX, sky_visibility
from workers.render.raster.batches import pack_shape
from workers.render.raster.draw_calls import sort_draws
from workers.render.raster.light_maps import LightMaps

TIERS = {"flat": FLAT, "raster": RASTER, "four samples": FOUR}
PLAIN_WHITE = Appearance((0.7,) * 3, (), BLACK, (0.7,) * 3)


def labels_of(seen) -> tuple[bytes, bytes]:
    return seen.depth_m.tobytes(), seen.region.tobytes()


# ---------------------------------------------------------------------------------------------- light


def test_a_white_plane_under_one_light_is_as_bright_as_lambert_says(renderer):
    """No light but the key: color x albedo x cosine, to 2 %, below the knee of the tone curve."""
    view = camera(small(33, 33), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    for angle in (0.0, 0.4, 0.8, 1.1):
        light = Light(frozen_array([np.sin(angle), 0.0, np.cos(angle)]), (0.75, 0.75, 0.75))
        seen = renderer.draw([white_floor()], Appearance(BLACK, (light,), BLACK), view, *RASTER)
        assert brightness(seen.rgb)[16, 16] == pytest.approx(0.75 * np.cos(angle), rel=0.02), f"at {angle} rad"


@pytest.mark.parametrize("light", sorted(STUDIO_LIGHTS))
def test_light_of_a_studio_shows_the_shape_of_a_white_ball_and_draws_no_line_along_its_outline(renderer, light):
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    part = Part(
        "ball", frozen_array(ball.vertices), frozen_array(ball.faces, np.int32), Material((1.0,) * 4, roughness=0.3)
    )
    shape = Shape((replace(part, normals=frozen_array(ball.vertices / 0.5)),))
    alone = without(RASTER, "shadows", "ambient_occlusion", "light_maps")
    for yaw in np.arange(4) * math.pi / 2:
        view = camera(small(400, 400), orbit_pose(np.zeros(3), 0.0, yaw, 1.2))
        seen = renderer.draw([Placed(3, shape, np.eye(4))], STUDIO_LIGHTS[light], view, *alone)
        light_of = brightness(seen.rgb)
        rows, columns = np.nonzero(seen.region == 3)
        across = light_of[200, columns[rows == 200]]
        down = light_of[rows[columns == 200], 200]
        assert seen.rgb[seen.region == 3].max() < 254, "nothing is clipped"
        assert down.max() > 1.3 * down.min(), "it is no disc"
        if light != "three_point":  # whose lights stand on one side
            assert across.max() < 1.15 * across[len(across) // 2]


@pytest.mark.minute
@pytest.mark.parametrize("level_m", [0.0, 0.6], ids=["on the floor", "on a table"])
def test_a_boxs_shadow_ends_where_geometry_says_and_without_it_the_place_has_lamberts_brightness(renderer, level_m):
    """A box 0.2 high throws a shadow 0.2 / tan of the light's elevation long: its end, within 2 px of the image.

    Without shadows: the key light alone, color 0.9 x cosine 0.8 on white, to 2 %; and no shadow map is made.
    """
    box = shape_of(trimesh.creation.box((0.2, 0.2, 0.2)))
    slab = with_material(shape_of(trimesh.creation.box((1.6, 1.2, 0.05))), WHITE_MATTE)
    table = [Placed(2, slab, translation(0.0, 0.0, level_m - 0.025))] if level_m else []
    things = [white_floor(), *table, Placed(3 if table else 2, box, translation(0.0, 0.0, level_m + 0.1))]
    view = camera(T=orbit_pose(np.array([0.0, 0.0, level_m]), 1.0, -np.pi / 2, 1.5))
    shadowed = renderer.draw(things, DOWN, view, *RASTER)
    places = [pixel_of(np.array([x, 0.0, level_m]), view) for x in np.linspace(-0.12, -0.40, 281)]
    profile = [brightness(shadowed.rgb)[int(v), int(u)] for u, v in places]
    assert profile[-1] > 0.1
    assert profile[10] < 0.1 * profile[-1], "in the middle of the shadow there is hardly any light"
    edge = next(u for (u, _), value in zip(places, profile, strict=True) if value > 0.5 * profile[-1])
    end = pixel_of(np.array([-0.1 - 0.2 * 0.6 / 0.8, 0.0, level_m]), view)
    assert edge == pytest.approx(end[0], abs=2.0)
    with counted("_cast") as cast:
        lit = renderer.draw(things, DOWN, view, *without(RASTER, "shadows"))
    assert cast.call_count == 0, "a shadow map was made"
    u, v = (int(c) for c in places[40])
    assert brightness(shadowed.rgb)[v, u] < 0.1 * 0.72
    assert brightness(lit.rgb)[v, u] == pytest.approx(0.9 * 0.8, rel=0.02)
    assert labels_of(lit) == labels_of(shadowed)


def test_sky_that_is_seen_beside_a_wall_and_below_a_board():
    """An endless wall of height h at distance d hides half of 1 - d / sqrt(d^2 + h^2) of the sky; a board lets light in from
    the sides."""
    top, nothing, step = np.zeros((120, 120), np.float32), np.zeros((120, 120), np.float32), 0.01
    top[:, 60:] = 0.06
    seen = sky_visibility(top, nothing, nothing, step)
    for steps in (2, 4, 8):
        expected = 1.0 - 0.5 * (1.0 - steps * step / math.hypot(steps * step, 0.06))
        assert seen[60, 60 - steps] == pytest.approx(expected, abs=0.06)
    board = np.zeros((80, 80), np.float32)
    board[30:50, 30:50] = 1.0
    low, high = (sky_visibility((z + 0.02) * board, z * board, 0.0 * board, step) for z in (0.1, 0.4))
    assert 0.35 < low[40, 40] < 0.7
    assert low[40, 40] < low[40, 52] < low[40, 70] <= 1.0
    assert high[40, 40] > low[40, 40]


def test_both_sides_of_a_face_are_drawn_and_lit(renderer):
    """The same square seen from its front and from its back, lit from the camera's side, with shading normals or none."""
    key = Appearance(BLACK, (Light(frozen_array([0.0, 0.0, -1.0]), (0.5, 0.5, 0.5)),), BLACK)
    (part,) = facing(2.0).parts
    for normals in (None, frozen_array([[0.0, 0.0, 1.0]] * 4)):
        front = replace(part, material=Material(roughness=1.0), normals=normals)
        back = replace(front, faces=frozen_array(part.faces[:, ::-1], np.int32))
        seen = [renderer.draw([Placed(3, Shape((p,)), EYE)], key, camera(small(8, 8))) for p in (front, back)]
        assert all((view.region == 3).all() for view in seen)
        np.testing.assert_array_equal(seen[0].rgb, seen[1].rgb)
        assert seen[0].rgb.min() > 60


TEXTURE = np.random.default_rng(4).integers(60, 256, (16, 16, 3), np.uint8)
MATERIALS = {
    "dielectric": Material((0.8, 0.5, 0.3, 1.0), 0.0, 0.35),
    "metal": Material((0.9, 0.7, 0.4, 1.0), 1.0, 0.45),
    "half metal": Material((0.9, 0.7, 0.4, 1.0), 0.5, 0.6, texture=TEXTURE),
    "matte": Material((0.6, 0.6, 0.6, 1.0), 0.0, 1.0, texture=TEXTURE),
}
TWO_LIGHTS = Appearance(
    (0.25, 0.3, 0.4),
    tuple(
        Light(frozen_array(towards), color)
        for towards, color in (([-0.48, 0.36, 0.8], (0.5, 0.45, 0.4)), ([0.6, 0.0, 0.8], (0.1, 0.15, 0.2)))
    ),
    (0.1, 0.08, 0.05),
)


def slab_of(material: Material, varied: bool) -> Shape:
    """A square 1 m wide and 0.04 m thick; `varied`: one corner is darker by one of 255 steps, so that colours vary."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array([0.5, 0.5, 0.02])
    quads = ((1, 5, 7, 3), (0, 2, 6, 4), (0, 4, 5, 1), (4, 6, 7, 5), (6, 2, 3, 7), (2, 0, 1, 3))
    faces = frozen_array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))], np.int32)
    colors, uv = np.full((8, 4), 255, np.uint8), frozen_array(corners[:, :2] + 0.5)
    colors[7, :3] = 254
    return Shape((Part("p", frozen_array(corners), faces, material, None, uv, colors if varied else None),))


@pytest.mark.parametrize("tier", ["flat", "raster"])
@pytest.mark.parametrize("level", [True, False], ids=["top", "wall"])
def test_a_face_has_the_light_that_each_of_its_pixels_would_find(renderer, tier, level):
    """To two steps, from five sides: among them where a light is mirrored."""
    look = FLAT if tier == "flat" else without(RASTER, "antialiasing")
    T, ball = translation(0.0, 0.0, 0.6), part_of(trimesh.creation.icosphere(2, 0.08))
    T = T if level else T @ np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    above = Placed(3, Shape((ball,)), translation(0.1, 0.2, 0.7 if level else 1.2))
    for name, material in MATERIALS.items():
        shapes = [slab_of(material, varied) for varied in (False, True)]
        (once,), (everywhere,) = map(pack_shape, shapes)
        assert once.planar and once.planar_top and not everywhere.planar and not everywhere.planar_top
        brightest = 0
        for yaw in (0.0, 1.3, 2.4, 3.6, 5.7):
            view = camera(small(120, 90), orbit_pose(np.array([0.0, 0.0, 0.6]), 0.7, yaw, 1.4))
            a, b = (renderer.draw([floor(), Placed(2, one, T), above], TWO_LIGHTS, view, *look) for one in shapes)
            assert labels_of(a) == labels_of(b) and (a.region == 2).sum() > 300
            assert np.abs(a.rgb.astype(int) - b.rgb).max() <= 2, name
            brightest = max(brightest, int(a.rgb[a.region == 2].max()))
        assert brightest > 120


def test_a_texture_stands_upright_and_multiplies_colours(renderer):
    """uv (0, 0) is the texture's lower left corner; the square's lower left corner in the image has it."""
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32, 0] = texture[:32, 32:, 1] = texture[32:, :32, 2] = texture[32:, 32:] = 255
    vertices = frozen_array([[-1, 1, 2], [1, 1, 2], [1, -1, 2], [-1, -1, 2]])  # y is down
    uv, faces = frozen_array([[0, 0], [1, 0], [1, 1], [0, 1]]), frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)
    high, low, half = 255, encode_srgb(np.array(0.04)) * 255, encode_srgb(decode_srgb(np.array(0.5)) + 0.04) * 255
    expected = np.array([[(high, low, low), (low, high, low)], [(low, low, half), (high, high, half)]])
    for image in (texture, np.dstack([texture, np.full((64, 64), 255, np.uint8)])):
        shape = Shape((Part("p", vertices, faces, Material((1.0, 1.0, 0.5, 1.0), texture=image), uv=uv),))
        seen = renderer.draw([Placed(3, shape, EYE)], WHITE, camera(small(40, 40)))
        assert np.abs(seen.rgb[15:26:10, 15:26:10] - expected).max() <= 2


# ---------------------------------------------------------------------------------------------- edges and holes


@pytest.mark.parametrize("tier", ["raster", "four samples"])
def test_a_slanted_edge_is_smooth_with_antialiasing_and_without_it_a_pixel_has_the_colour_of_its_centre(renderer, tier):
    """White on black: along each row brightness never falls, and every other row has something in between."""
    corners = [[0.0, -2.0, 2.0], [3.0, -2.0, 2.0], [3.0, 2.0, 2.0], [1.2, 2.0, 2.0]]
    white, view = (
        Placed(3, quad(corners, material=Material((1, 1, 1, 1))), translation(-0.6, 0, 0)),
        camera(small(80, 80)),
    )
    smooth, sharp = (
        renderer.draw([white], PLAIN_WHITE, view, *look) for look in (TIERS[tier], without(TIERS[tier], "antialiasing"))
    )
    assert labels_of(smooth) == labels_of(sharp)
    rows = smooth.rgb[4:-4, :, 1].astype(int)
    assert (np.diff(rows, axis=1)[:, 4:-4] >= -1).all()
    between = (rows > 0.1 * rows.max()) & (rows < 0.9 * rows.max())
    assert between.any(axis=1).mean() > 0.5
    inside = sharp.region == 3
    assert (sharp.rgb[~inside] == 0).all() and len(np.unique(sharp.rgb[inside], axis=0)) == 1


def test_the_floor_has_no_edges_amid_its_texture():
    rgb = np.zeros((6, 6, 3), np.uint8)
    rgb[:, 3:] = 100
    assert (find_edges(rgb, np.ones((6, 6), np.uint8)) == 0).all()
    edges = find_edges(rgb, np.full((6, 6), 2, np.uint8))
    assert (edges[:, 2:4] == 255).all() and edges.sum() == 12 * 255


@pytest.mark.parametrize("tier", ["raster", "four samples"])
def test_through_a_hole_in_a_texture_one_sees_what_is_behind_and_labels_are_solid(renderer, tier):
    texture = np.full((8, 8, 4), 255, np.uint8)
    texture[:, :4, 3] = 0
    red = Material((1.0, 0.0, 0.0, 1.0), texture=texture)
    (part,) = facing(2.0, 1.0).parts
    front = replace(part, material=red, uv=frozen_array([[0, 0], [1, 0], [1, 1], [0, 1]]))
    behind = with_material(facing(4.0, 9.0), Material((0.0, 0.0, 1.0, 1.0)))
    things = [Placed(2, behind, EYE), Placed(3, Shape((front,)), EYE)]
    seen = renderer.draw(things, PLAIN_WHITE, camera(small(40, 40)), *TIERS[tier])
    left, right = seen.rgb[20, 13], seen.rgb[20, 27]
    assert left[2] > 150 > 100 > left[0]
    assert right[0] > 150 > 100 > right[2]
    assert (seen.region[11:29, 11:29] == 3).all()
    assert np.abs(seen.depth_m[11:29, 11:29] - 2.0).max() < 1e-5


# ---------------------------------------------------------------------------------------------- effects


def test_labels_are_the_same_to_the_byte_whatever_is_drawn_of_colour(renderer):
    rng = np.random.default_rng(950)
    things, height = procedural_things(rng)
    looks = [*TIERS.values(), *(without(look, name) for look in TIERS.values() for name in ("rgb", "textures"))]
    looks += [without(RASTER, name) for name in ("shadows", "ambient_occlusion", "antialiasing", "light_maps")]
    for view in orbit_and_mirror(rng, height):
        assert len({labels_of(renderer.draw(things, APPEARANCE, view, *look)) for look in looks}) == 1


def counted(name: str):
    """A method of the light maps that does its work and counts its calls."""
    return mock.patch.object(LightMaps, name, autospec=True, side_effect=getattr(LightMaps, name))


def work(renderer, look: Look) -> Counter[str]:
    """What one view of a scene without textures takes: passes, maps, and draw calls by kind."""
    rng = np.random.default_rng(2_000)
    things, height = random_things(rng)
    view, done = orbit_and_mirror(rng, height)[0], Counter[str]()

    def sort(*args):
        sorted_draws = sort_draws(*args)
        done["passes"] += 1
        for variant, draws in sorted_draws.items():
            done["textured"] += len(draws) * variant.textured
            done["cut out"] += len(draws) * variant.cutout
            done.update(f"region {draw.thing.region_id}" for draw in draws)
            done[f"pass {done['passes']}"] += sum(draw.count for draw in draws)
        return sorted_draws

    renderer.draw(things[:1], APPEARANCE, view, *RASTER)  # the light of another scene
    with mock.patch.object(workers.render.raster.gbuffer, "sort_draws", sort), counted("_bake") as bake:
        renderer.draw(things, APPEARANCE, view, *look)
    done["maps"] = bake.call_count
    return done


def test_a_forced_pass_does_its_work_where_nothing_calls_for_it(renderer):
    plain = work(renderer, RASTER)
    assert (plain["passes"], plain["textured"], plain["cut out"]) == (1, 0, 0)
    forced = work(renderer, forcing(RASTER, "transparency"))
    assert forced["passes"] == 3
    assert forced["pass 2"] == forced["pass 3"], "of faces at one depth another would be seen where nothing has holes"
    assert work(renderer, forcing(RASTER, "transparency", "textures"))["cut out"] > 0
    assert work(renderer, forcing(RASTER, "textures"))["textured"] == sum(plain[f"region {n}"] for n in range(1, 9))
    assert work(renderer, FLAT)["maps"] == 0
    assert work(renderer, forcing(FLAT, "light_maps"))["maps"] == 1
    again = work(renderer, forcing(without(RASTER, "floor"), "floor"))
    assert again["region 1"] == plain["region 1"] > 0


def test_light_is_worked_out_once_a_scene_and_none_of_another_scene_is_seen(renderer):
    rng = np.random.default_rng(2_000)
    things, height = random_things(rng)
    (view, mirror), dark = orbit_and_mirror(rng, height), without(RASTER, "light_maps")
    renderer.draw(things[:2], APPEARANCE, view, *RASTER)
    one = renderer.draw(things, APPEARANCE, view, *dark).rgb
    with counted("_bake") as bake:
        lit = [renderer.draw(things, APPEARANCE, each, *RASTER).rgb for each in (view, mirror, view, mirror)]
    assert bake.call_count == 1
    assert 4 * (SHADOW_PX**2 + 2 * MAP_PX**2) <= 8 * 2**20
    assert one.astype(np.int64).sum() > lit[0].astype(np.int64).sum()
    for look in (dark, without(RASTER, "shadows", "ambient_occlusion")):
        assert np.array_equal(one, renderer.draw(things, APPEARANCE, view, *look).rgb)


@pytest.mark.parametrize("light", ["key", *sorted(STUDIO_LIGHTS)])
def test_without_light_maps_the_bytes_are_those_of_looking_up_maps_that_darken_nothing(renderer, light):
    rng, look = np.random.default_rng(951), without(RASTER, "light_maps")
    things, height = procedural_things(rng)
    view, appearance = orbit_and_mirror(rng, height)[0], STUDIO_LIGHTS.get(light, APPEARANCE)
    drawn = renderer.draw(things, appearance, view, *look)
    with mock.patch.object(LightMaps, "absent", False):
        assert np.array_equal(drawn.rgb, renderer.draw(things, appearance, view, *look).rgb)
    assert len(np.unique(drawn.rgb)) > 50
