"""A framebuffer is cleared and read in the size that was bound last."""

import numpy as np
import pytest

from schemas.scene.appearance import Appearance
from workers.geometry.srgb import encode_srgb
from workers.render.raster.framebuffer import Framebuffer


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
