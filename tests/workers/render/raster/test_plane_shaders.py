"""Light that is found once a face, against light that is found at every pixel."""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from tests.workers.render.looks import FLAT, RASTER, without
from tests.workers.render.random_scenes import camera, floor, part_of, small
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import translation
from workers.render.raster.batches import pack_shape

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
