"""Shading of tier raster, against geometry and Lambert's law."""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light
from tests.workers.render.looks import BLACK, DOWN, RASTER, brightness, pixel_of, white_floor
from tests.workers.render.random_scenes import camera, floor, shape_of, small
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import decode_srgb
from workers.geometry.frames import translation


def test_a_white_plane_under_one_light_is_as_bright_as_lambert_says(renderer):
    """No light but the key: color x albedo x cosine, to 2 %, below the knee of the tone curve."""
    view = camera(small(33, 33), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    for angle in (0.0, 0.4, 0.8, 1.1):
        light = Light(frozen_array([np.sin(angle), 0.0, np.cos(angle)]), (0.75, 0.75, 0.75))
        seen = renderer.draw([white_floor()], Appearance(BLACK, (light,), BLACK), view, *RASTER)
        assert brightness(seen.rgb)[16, 16] == pytest.approx(0.75 * np.cos(angle), rel=0.02), f"at {angle} rad"


def test_too_much_light_bends_towards_white_and_keeps_its_order(renderer):
    view, seen = camera(small(9, 9), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0)), []
    for level in (0.5, 1.0, 1.5, 3.0, 10.0):
        look = Appearance(BLACK, (Light(frozen_array([0.0, 0.0, 1.0]), (level,) * 3),), BLACK)
        seen.append(int(renderer.draw([floor()], look, view, *RASTER).rgb[4, 4, 1]))
    assert seen == sorted(set(seen)) and seen[-1] <= 255


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


def test_the_lit_side_of_a_thing_does_not_shade_itself(renderer):
    """A fine sphere: wherever the light comes from above 20 degrees to the face, it has Lambert's brightness."""
    ball = trimesh.creation.icosphere(5, 0.12)
    things = [floor(), Placed(3, shape_of(ball), translation(0.0, 0.0, 0.5))]
    view = camera(T=orbit_pose(np.array([0.0, 0.0, 0.5]), 0.8, 0.2, 1.0))
    seen = renderer.draw(things, DOWN, view, *RASTER)
    k = view.intrinsics
    v, u = np.nonzero(seen.region == 3)
    z = seen.depth_m[v, u]
    points = np.stack([(u + 0.5 - k.cx) / k.fx * z, (v + 0.5 - k.cy) / k.fy * z, z, np.ones_like(z)])
    normals = ((view.T_world_cam @ points)[:3].T - [0.0, 0.0, 0.5]) / 0.12
    cosine = normals @ [0.6, 0.0, 0.8]
    chosen = cosine > np.sin(np.radians(20.0))
    share = brightness(seen.rgb)[v, u][chosen] / (0.9 * decode_srgb(np.array(0.7)) * cosine[chosen])
    assert np.percentile(share, 1) > 0.85
