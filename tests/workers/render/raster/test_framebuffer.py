"""Framebuffers are cleared and read in the size that was bound last; passes for colour alone show holes in textures."""

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Material, Part, Shape
from tests.workers.render.looks import BLACK, FOUR, RASTER
from tests.workers.render.random_scenes import EYE, camera, facing, quad, small
from workers.geometry.colour import encode_srgb
from workers.render.raster.context import Framebuffer


@pytest.mark.parametrize("sizes", [[(8, 6)], [(8, 6), (40, 3), (8, 6)]], ids=["one", "resized"])
def test_a_cleared_framebuffer_shows_the_background_in_every_pixel(renderer, sizes):
    gl = renderer._gl
    target = Framebuffer(gl, {gl.GL_COLOR_ATTACHMENT0: gl.GL_RGBA8, gl.GL_DEPTH_ATTACHMENT: gl.GL_DEPTH_COMPONENT32F})
    background = (0.2, 0.5, 0.8)
    for width, height in sizes:
        target.bind(width, height)
        assert target.size == (width, height)
        target.clear(Appearance((0.0,) * 3, (), background))
        seen = target.read(np.zeros((height, width, 4), np.uint8))
        assert np.abs(seen[..., :3] - 255.0 * encode_srgb(np.array(background))).max() <= 0.51
        assert (seen[..., 3] == 0).all()


def test_a_size_that_the_driver_refuses_is_named(renderer):
    gl = renderer._gl
    target = Framebuffer(gl, {gl.GL_DEPTH_ATTACHMENT: gl.GL_RGBA8})
    with pytest.raises(RuntimeError, match=r"a framebuffer of 8 x 6 is not complete"):
        target.bind(8, 6)


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
