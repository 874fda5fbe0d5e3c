"""Textures with holes and without."""

import numpy as np
import pytest

from workers.geometry.colour import has_holes


@pytest.mark.parametrize(("alpha", "holes"), [(255, False), (128, False), (127, True), (0, True)])
def test_a_texel_more_transparent_than_not_is_a_hole(alpha, holes):
    texture = np.full((3, 4, 4), 255, np.uint8)
    texture[1, 2, 3] = alpha
    assert has_holes(texture) is holes


def test_without_alpha_there_are_no_holes():
    assert not has_holes(np.zeros((2, 2, 3), np.uint8))
    assert not has_holes(None)
