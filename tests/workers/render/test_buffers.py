"""Textures before they are uploaded."""

import numpy as np

from workers.render.buffers import MAX_TEXTURE_PX, mip_levels


def test_levels_halve_down_to_one_pixel_and_keep_the_mean():
    image = np.random.default_rng(0).integers(0, 256, (64, 32, 3), dtype=np.uint8)
    levels = mip_levels(image)
    assert [level.shape for level in levels] == [(64 >> i, max(1, 32 >> i), 4) for i in range(7)]
    for level in levels:
        assert np.abs(level[..., :3].mean(axis=(0, 1)) - image.mean(axis=(0, 1))).max() < 2.0
        assert (level[..., 3] == 255).all()


def test_the_first_row_uploaded_is_the_images_last():
    image = np.zeros((4, 4, 4), np.uint8)
    image[3] = (10, 20, 30, 40)
    assert mip_levels(image)[0][0].tolist() == [[10, 20, 30, 40]] * 4


def test_a_large_texture_is_made_smaller():
    levels = mip_levels(np.full((MAX_TEXTURE_PX * 2, 100, 3), 77, np.uint8))
    assert levels[0].shape == (MAX_TEXTURE_PX, 50, 4)
    assert (levels[0][..., :3] == 77).all()
