"""Colours, materials and painted textures."""

import numpy as np
import pytest

from workers.assets.builtin import materials
from workers.assets.builtin import materials as palette
from workers.assets.builtin import materials as textures


@pytest.mark.parametrize("draw", [palette.vivid, palette.pale, palette.glaze_color, palette.glass_color])
def test_every_colour_is_within_range(draw):
    rng = np.random.default_rng(0)
    colors = np.array([draw(rng) for _ in range(300)])
    assert colors.shape == (300, 3)
    assert colors.min() >= 0.0
    assert colors.max() <= 1.0
    assert len(np.unique(colors, axis=0)) > 200


def test_ink_can_be_read_on_its_paper():
    rng = np.random.default_rng(1)
    for _ in range(300):
        paper = palette.vivid(rng) if rng.random() < 0.5 else palette.pale(rng)
        ink = palette.ink_on(rng, paper)
        assert max(abs(a - b) for a, b in zip(ink, paper, strict=True)) > 0.1


def test_materials_are_within_what_gltf_allows():
    rng = np.random.default_rng(2)
    for draw in (materials.plastic, materials.steel, materials.metal):
        for _ in range(100):
            material = draw(rng)
            assert 0.0 <= material.metallic <= 1.0
            assert 0.05 <= material.roughness <= 1.0
            assert material.base_color[3] == 1.0


A, B = (0.2, 0.4, 0.6), (0.9, 0.8, 0.1)


def rng():
    return np.random.default_rng(3)


@pytest.mark.parametrize(("smooth", "quarter"), [(False, 0.25), (True, 0.25**2 * (3 - 2 * 0.25))])
def test_a_stretched_lattice_keeps_its_points_and_lies_between_them_otherwise(smooth, quarter):
    lattice = np.array([[0.0, 8.0, 4.0], [2.0, 6.0, 1.0]], np.float32)  # two columns, three rows
    plane = textures.stretched(lattice, 12, 8, smooth)
    assert plane.shape == (12, 8)
    assert np.array_equal(plane[::4, ::4], lattice.T)
    assert plane[0, [1, 2, 5]] == pytest.approx([2.0 * quarter, 1.0, 2.0 - 2.0 * quarter])
    assert plane[[1, 2, 9], 0] == pytest.approx([8.0 * quarter, 4.0, 4.0 - 4.0 * quarter])


def test_noise_is_smooth_within_its_bounds_and_repeats_in_both_directions():
    plane = textures.noise(rng(), 64, 96, 4, 6)
    assert plane.shape == (64, 96)
    assert 0.0 <= plane.min() < 0.3 < 0.7 < plane.max() <= 1.0
    for axis in (0, 1):
        step = np.abs(np.diff(np.concatenate([plane, plane.take([0], axis)], axis), axis=axis))
        assert step.max() < 0.12


@pytest.mark.parametrize(
    "make",
    [
        lambda: textures.wood(rng(), A, B, planks=4),
        lambda: textures.stone(rng(), A, B),
        lambda: textures.speckled(rng(), A, B, 0.1),
        lambda: textures.bands(rng(), [A, B, A]),
        lambda: textures.upright_stripes(rng(), [A, B]),
        lambda: textures.dots(rng(), A, B),
        lambda: textures.label(rng(), A, 40),
        lambda: textures.label(rng(), A, 16, 256, 3),
    ],
)
def test_every_picture_is_small_of_bytes_has_more_than_one_colour_and_comes_again(make):
    picture = make()
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert max(picture.shape) <= 256
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1
    assert (make() == picture).all()


def test_pixels_are_square_on_a_cylinder():
    assert textures.band_height(0.0, 0.1, 0.1 / np.pi, 256) == 128
    assert textures.band_height(0.0, 1e-6, 0.1) == 16
    assert textures.band_height(0.0, 9.0, 0.1) == 192
