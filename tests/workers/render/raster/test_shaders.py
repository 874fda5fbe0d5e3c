"""Shading of tier raster, against geometry and Lambert's law.

Light that is found once a face, against light that is found at every pixel. Colours, against what light and albedo
say.
"""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from tests.workers.render.looks import BLACK, DOWN, FLAT, RASTER, brightness, pixel_of, white_floor, without
from tests.workers.render.random_scenes import EYE, WHITE, camera, floor, part_of, shape_of, small
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import decode_srgb, encode_srgb
from workers.geometry.frames import translation
from workers.render.raster.batches import pack_shape


def test_a_white_plane_under_one_light_is_as_bright_as_lambert_says(renderer):
    """No light but the key: color x albedo x cosine, to 2 %, below the knee of the tone curve."""
    view = camera(small(33, 33), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    for angle in (0.0, 0.4, 0.8, 1.1):
        light = Light(frozen_array([np.sin(angle), 0.0, np.cos(angle)]), (0.75, 0.75, 0.75))
        seen = renderer.draw([white_floor()], Appearance(BLACK, (light,), BLACK), view, *RASTER)
        assert brightness(seen.rgb)[16, 16] == pytest.approx(0.75 * np.cos(angle), rel=0.02), f"at {angle} rad"


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
    seen = brightness(renderer.draw(things, DOWN, view, *RASTER).rgb)
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


LOOKS = {"flat": FLAT, "raster": without(RASTER, "antialiasing")}

TEXTURE = np.random.default_rng(4).integers(60, 256, (16, 16, 3), np.uint8)
MATERIALS = {
    "dielectric": Material((0.8, 0.5, 0.3, 1.0), 0.0, 0.35),
    "metal": Material((0.9, 0.7, 0.4, 1.0), 1.0, 0.45),
    "half metal": Material((0.9, 0.7, 0.4, 1.0), 0.5, 0.6, texture=TEXTURE),
    "matte": Material((0.6, 0.6, 0.6, 1.0), 0.0, 1.0, texture=TEXTURE),
}
LOOK = Appearance(
    (0.25, 0.3, 0.4),
    (
        Light(frozen_array([-0.48, 0.36, 0.8]), (0.5, 0.45, 0.4)),
        Light(frozen_array([0.6, 0.0, 0.8]), (0.1, 0.15, 0.2)),
    ),
    (0.1, 0.08, 0.05),
)


def slab(material: Material, varied: bool) -> Shape:
    """A square 1 m wide and 0.04 m thick; `varied`: one corner is darker by one of 255 steps, so that colours vary."""
    half = np.array([0.5, 0.5, 0.02])
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = ((1, 5, 7, 3), (0, 2, 6, 4), (0, 4, 5, 1), (4, 6, 7, 5), (6, 2, 3, 7), (2, 0, 1, 3))
    faces = frozen_array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))], np.int32)
    colors = np.full((8, 4), 255, np.uint8)
    colors[7, :3] = 254
    uv = frozen_array(corners[:, :2] + 0.5)
    return Shape((Part("p", frozen_array(corners), faces, material, None, uv, colors if varied else None),))


@pytest.mark.parametrize("tier", ["flat", "raster"])
@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("level", [True, False], ids=["top", "wall"])
def test_a_face_has_the_light_that_each_of_its_pixels_would_find(renderer, tier, name, level):
    """To two steps, from five sides: among them where a light is mirrored."""
    plain, varied = (slab(MATERIALS[name], varied) for varied in (False, True))
    (once,), (everywhere,) = pack_shape(plain), pack_shape(varied)
    assert once.planar and once.planar_top
    assert not everywhere.planar and not everywhere.planar_top
    stand, ball = translation(0.0, 0.0, 0.6), part_of(trimesh.creation.icosphere(2, 0.08))
    T = stand if level else stand @ np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    brightest = 0
    for yaw in (0.0, 1.3, 2.4, 3.6, 5.7):
        view = camera(small(120, 90), orbit_pose(np.array([0.0, 0.0, 0.6]), 0.7, yaw, 1.4))
        seen = []
        for shape in (plain, varied):
            things = [
                floor(),
                Placed(2, shape, T),
                Placed(3, Shape((ball,)), translation(0.1, 0.2, 0.7 if level else 1.2)),
            ]
            seen.append(renderer.draw(things, LOOK, view, *LOOKS[tier]))
        a, b = seen
        assert a.depth_m.tobytes() == b.depth_m.tobytes() and a.region.tobytes() == b.region.tobytes()
        assert (a.region == 2).sum() > 300
        assert np.abs(a.rgb.astype(int) - b.rgb).max() <= 2
        brightest = max(brightest, int(a.rgb[a.region == 2].max()))
    assert brightest > 120


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
