"""Passes for colour alone: holes in textures."""

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.appearance import Appearance
from schemas.scene.scene import Placed
from schemas.scene.shape import Material, Part, Shape
from tests.workers.render.looks import BLACK, FOUR, RASTER
from tests.workers.render.random_scenes import EYE, camera, facing, quad, small


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
    seen = renderer.draw(things, look, camera(small(40, 40)), *render)
    left, right = seen.rgb[20, 13], seen.rgb[20, 27]
    assert left[2] > 150 > 100 > left[0]
    assert right[0] > 150 > 100 > right[2]
    assert (seen.region[11:29, 11:29] == 3).all()
    assert np.abs(seen.depth_m[11:29, 11:29] - 2.0).max() < 1e-5
