"""Light maps before they are uploaded, against geometry."""

import numpy as np
import pytest
import trimesh

from schemas.scene.scene import Placed
from tests.workers.render.random_scenes import floor, shape_of
from workers.geometry.frames import transform, translation
from workers.render.raster.baking import (
    MAP_PX,
    SCENE_MARGIN_M,
    level_box,
    level_pixels,
    level_shadow,
    light_box,
    objects_of,
    shadow_casters,
    triangles_of,
)

TOWARDS = np.array([0.6, 0.0, 0.8])
BOX = shape_of(trimesh.creation.box((0.2, 0.2, 0.2)))


def things():
    return [floor(), Placed(2, BOX, translation(0.0, 0.0, 0.1)), Placed(3, BOX, translation(0.3, 0.1, 0.3))]


def test_the_lights_box_holds_every_vertex_and_its_depth_grows_away_from_the_light():
    vertices, _ = triangles_of(shadow_casters(things()))
    box = light_box(vertices, TOWARDS)
    unit = transform(box.unit_from_world, vertices)
    assert (unit > 0.0).all() and (unit < 1.0).all()
    size = box.bounds[1] - box.bounds[0]
    assert unit.min(axis=0) * size == pytest.approx(SCENE_MARGIN_M) == (1.0 - unit.max(axis=0)) * size
    assert np.ptp(unit[:, 2] * size[2] + vertices @ TOWARDS) < 1e-12
    assert transform(box.clip_from_world, vertices) == pytest.approx(2.0 * unit - 1.0)


def test_a_levels_box_reaches_to_the_end_of_the_shadow_and_to_the_top():
    vertices, _ = triangles_of(objects_of(things()))
    low, high = level_box(vertices, 0.0, TOWARDS, 0.1).bounds
    assert low[0] <= 0.2 - 0.4 * 0.75 - 0.1 + 1e-9 and high[0] >= 0.4 + 0.1 - 1e-9
    assert (low[2], high[2]) == pytest.approx((0.0, 0.4))
    assert high[0] - low[0] == pytest.approx(high[1] - low[1])


def test_triangles_of_several_things_are_each_their_own():
    vertices, faces = triangles_of(objects_of(things()) + shadow_casters(things())[:1])
    assert vertices.shape == (16, 3) and faces[12:].min() == 8
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(2 * 0.2**3)


def test_an_empty_shadow_map_lets_the_key_light_reach_a_whole_level():
    vertices, faces = triangles_of(objects_of(things()))
    level = level_box(vertices, 0.2, TOWARDS, 0.1)
    depth = np.ones((64, 64), np.float32)
    assert (level_shadow(depth, light_box(vertices, TOWARDS), level, TOWARDS) == 255).all()
    pixels = level_pixels(vertices, faces, level, hollow=False)
    assert pixels.shape == (MAP_PX, MAP_PX, 4) and (pixels[..., 3] == 255).all()
    u, v, _ = MAP_PX * transform(level.unit_from_world, np.array([[0.3, 0.1, 0.3]]))[0]
    middle = pixels[int(v), int(u)]
    assert middle[2] == 255, "the top of the box is the top of the map's own box"
