"""Colours, against what light and albedo say."""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from tests.workers.render.looks import FLAT, RASTER
from tests.workers.render.random_scenes import (
    EYE,
    WHITE,
    camera,
    facing,
    floor,
    part_of,
    small,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import decode_srgb, encode_srgb
from workers.geometry.frames import translation

PLANE_MM = 0.001
"""float32 depth of a plane some metres away: a few units in the last place."""


@pytest.mark.parametrize("level", [0.0, 0.02, 0.2, 0.5, 0.9, 1.0])
def test_under_white_light_a_rough_surface_shows_its_base_color(renderer, level):
    """4 % of the light is mirrored and not albedo: ambient light adds it."""
    (part,) = facing(2.0).parts
    material = Material(base_color=(level, 0.5, 1.0 - level, 1.0))
    seen = renderer.draw(
        [Placed(3, Shape((Part("p", part.vertices, part.faces, material),)), EYE)], WHITE, camera(small(4, 4))
    )
    expected = encode_srgb(np.minimum(decode_srgb(np.array([level, 0.5, 1.0 - level])) + 0.04, 1.0)) * 255
    assert np.abs(seen.rgb[2, 2] - expected).max() <= 0.7


def test_light_falls_off_with_the_cosine(renderer):
    (part,) = facing(2.0).parts
    shape = Shape((Part("p", part.vertices, part.faces, Material((1.0, 1.0, 1.0, 1.0), roughness=1.0)),))
    for angle in (0.0, 0.5, 1.0, 1.4):
        light = Light(frozen_array([np.sin(angle), 0.0, -np.cos(angle)]), (0.5, 0.5, 0.5))
        seen = renderer.draw([Placed(3, shape, EYE)], Appearance((0.0,) * 3, (light,), (0.0,) * 3), camera(small(9, 9)))
        linear = decode_srgb(seen.rgb[4, 4] / 255.0)
        assert linear == pytest.approx(0.5 * np.cos(angle), abs=0.02), f"at {angle} rad"


def test_light_comes_from_where_it_comes_from_in_the_world(renderer):
    """A matte floor under a slanting light has one colour, that of the world's cosine, from wherever it is seen."""
    light = Light(frozen_array([0.6, 0.0, 0.8]), (0.5, 0.5, 0.5))
    look = Appearance((0.0,) * 3, (light,), (0.0,) * 3)
    grey = decode_srgb(np.array(0.7))
    for inclination, yaw in ((0.8, 0.0), (0.8, 2.0), (0.4, -1.0), (1.5, 0.7)):
        view = camera(small(9, 9), orbit_pose(np.zeros(3), inclination, yaw, 2.0))
        linear = decode_srgb(renderer.draw([floor()], look, view).rgb[4, 4] / 255.0)
        assert linear == pytest.approx(0.5 * 0.8 * grey, abs=0.005)


@pytest.mark.parametrize("tier", ["flat", "raster"])
def test_the_open_floor_has_the_light_of_the_sky_and_of_all_lamps(renderer, tier):
    """Away from all things: albedo times the light of the sky and of each lamp by its cosine, and 4 % of the sky mirrored."""
    box = Shape((part_of(trimesh.creation.box((0.1, 0.1, 0.1))),))
    colors, sky = ((0.3, 0.1, 0.2), (0.1, 0.2, 0.05)), np.array((0.2, 0.3, 0.4))
    lights = tuple(Light(frozen_array([x, 0.0, 0.8]), color) for x, color in zip((0.6, -0.6), colors, strict=True))
    look = Appearance(tuple(sky), lights, (0.1, 0.0, 0.0))
    view = camera(small(9, 9), orbit_pose(np.array([4.0, 4.0, 0.0]), 0.6, 1.0, 1.0))
    things = [floor(), Placed(3, box, translation(0.0, 0.0, 0.06))]
    rgb = renderer.draw(things, look, view, *(FLAT if tier == "flat" else RASTER)).rgb
    expected = decode_srgb(np.array(0.7)) * (sky + 0.8 * np.sum(colors, axis=0)) + 0.04 * sky
    assert np.abs(rgb[4, 4] - 255 * encode_srgb(expected)).max() <= 0.7


def test_a_smooth_metal_mirrors_a_light_and_a_rough_one_spreads_it(renderer):
    """GGX over pi, four times the cosine and a masking of 1: 1 / (4 roughness^4) of the light where it is mirrored."""
    (part,) = facing(2.0).parts
    seen = {}
    for roughness in (0.5, 0.7):
        shape = Shape((Part("p", part.vertices, part.faces, Material((1.0, 1.0, 1.0, 1.0), 1.0, roughness)),))
        for angle in (0.0, 0.8):
            light = Light(frozen_array([np.sin(angle), 0.0, -np.cos(angle)]), (0.1, 0.1, 0.1))
            view = renderer.draw(
                [Placed(3, shape, EYE)], Appearance((0.0,) * 3, (light,), (0.0,) * 3), camera(small(9, 9))
            )
            seen[roughness, angle] = decode_srgb(view.rgb[4, 4, 0] / 255.0)
    for roughness in (0.5, 0.7):
        assert seen[roughness, 0.0] == pytest.approx(0.1 / (4 * roughness**4), rel=0.03)
    spread = {roughness: seen[roughness, 0.8] / seen[roughness, 0.0] for roughness in (0.5, 0.7)}
    assert spread[0.5] < 0.5 * spread[0.7] < 0.5


def test_a_texture_stands_upright_and_multiplies_colours(renderer):
    """uv (0, 0) is the texture's lower left corner; the square's lower left corner in the image has it."""
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32], texture[:32, 32:], texture[32:, :32], texture[32:, 32:] = (
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
        255,
    )
    vertices = frozen_array([[-1, 1, 2], [1, 1, 2], [1, -1, 2], [-1, -1, 2]])  # y is down
    uv, faces = frozen_array([[0, 0], [1, 0], [1, 1], [0, 1]]), frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)
    for image in (texture, np.dstack([texture, np.full((64, 64), 255, np.uint8)])):
        material = Material((1.0, 1.0, 0.5, 1.0), texture=image)
        shape = Shape((Part("p", vertices, faces, material, uv=uv),))
        seen = renderer.draw([Placed(3, shape, EYE)], WHITE, camera(small(40, 40)))
        high, low, half = 255, encode_srgb(np.array(0.04)) * 255, encode_srgb(decode_srgb(np.array(0.5)) + 0.04) * 255
        expected = {
            (15, 15): (high, low, low),
            (15, 25): (low, high, low),
            (25, 15): (low, low, half),
            (25, 25): (high, high, half),
        }
        for (row, column), color in expected.items():
            assert np.abs(seen.rgb[row, column] - np.array(color)).max() <= 2


def test_vertex_colours_are_interpolated_in_linear_light(renderer):
    (part,) = facing(2.0, 2.0).parts
    colors = frozen_array([[0, 0, 0, 255], [255, 255, 255, 255], [255, 255, 255, 255], [0, 0, 0, 255]], np.uint8)
    shape = Shape((Part("p", part.vertices, part.faces, Material((1.0, 1.0, 1.0, 1.0)), colors=colors),))
    seen = renderer.draw([Placed(3, shape, EYE)], WHITE, camera(small(101, 101)))
    linear = decode_srgb(seen.rgb[50, :, 1] / 255.0)
    expected = np.minimum((np.arange(101) + 0.5) / 101 + 0.04, 1.0)
    assert np.abs(linear - expected)[:95].max() < 0.02


def test_many_triangles_look_like_few(renderer):
    """Two programs draw batches of few and of many triangles: a square of 2 and of 3,200 gives the same image."""
    (part,) = facing(2.0, 1.0).parts
    fine = trimesh.Trimesh(part.vertices, part.faces, process=False)
    for _ in range(6):
        fine = fine.subdivide()
    assert len(fine.faces) > 3000
    lights = (Light(frozen_array([0.3, 0.2, -0.93]), (0.6, 0.5, 0.4)),)
    look = Appearance((0.2, 0.2, 0.2), lights, (0.0, 0.0, 0.0))
    a, b = (renderer.draw([Placed(3, s, EYE)], look, camera()) for s in (Shape((part,)), Shape((part_of(fine),))))
    np.testing.assert_array_equal(a.region, b.region)
    assert np.abs(a.rgb.astype(int) - b.rgb).max() <= 1
    assert np.abs(a.depth_m - b.depth_m).max() * 1e3 < PLANE_MM


def test_too_many_lights_are_refused(renderer):
    lights = (Light(frozen_array([0.0, 0.0, 1.0]), (0.1, 0.1, 0.1)),) * 7
    with pytest.raises(ValueError, match="7 lights: the renderer takes at most 6"):
        renderer.draw([floor()], Appearance((0.1,) * 3, lights, (0.0,) * 3), camera())
