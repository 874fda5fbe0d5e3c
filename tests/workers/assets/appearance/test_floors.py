"""Floor materials: they repeat without a seam, are made once, and differ between scenes."""

import numpy as np
import pytest

from workers.assets.appearance import FLOOR_KINDS, PERIOD_M, TEXTURE_PX, draw_floor_material, make_pattern


@pytest.mark.parametrize("kind", range(len(FLOOR_KINDS)))
def test_a_floor_goes_on_where_it_ends(kind):
    """Across the seam neighbouring pixels differ no more than they do elsewhere."""
    for number in range(FLOOR_KINDS[kind].patterns):
        texture = make_pattern(kind, number).texture.astype(int)
        assert texture.shape == (TEXTURE_PX, TEXTURE_PX, 3)
        for axis in (0, 1):
            steps = np.abs(np.diff(texture, axis=axis)).mean(axis=(1 - axis, 2))
            seam = np.abs(np.take(texture, 0, axis) - np.take(texture, -1, axis)).mean()
            assert seam <= steps.max() * 1.15, number


def test_patterns_are_made_once_and_no_two_are_alike():
    """A renderer keeps what it uploaded by the array's identity, and a process keeps no more than the collection."""
    every = [(kind, n) for kind in range(len(FLOOR_KINDS)) for n in range(FLOOR_KINDS[kind].patterns)]
    textures = [make_pattern(*which).texture for which in every]
    assert all(make_pattern(*which).texture is texture for which, texture in zip(every, textures, strict=True))
    assert len({texture.tobytes() for texture in textures}) == len(every)
    assert not any(texture.flags.writeable for texture in textures)
    assert sum(texture.nbytes for texture in textures) < 32 * 1024 * 1024
    drawn = [draw_floor_material(np.random.default_rng(seed)) for seed in range(600)]
    assert {id(material.texture) for material, _ in drawn} == {id(texture) for texture in textures}


def test_a_pattern_leaves_the_floor_the_colour_that_its_kind_drew():
    """White stands for the lightest shade: colour times the texture's mean is the colour times the mean shade."""
    for kind, kind_of_floor in enumerate(FLOOR_KINDS):
        pattern = make_pattern(kind, 0)
        shade = kind_of_floor.draw_shades(np.random.default_rng(np.random.SeedSequence(48_271, spawn_key=(kind, 0))))
        assert pattern.texture.max() == 255
        assert pattern.texture.mean() / 255.0 * pattern.white == pytest.approx(float(np.mean(shade)), abs=0.002)


def test_floors_differ_in_colour_scale_and_angle():
    drawn = [draw_floor_material(np.random.default_rng(seed)) for seed in range(200)]
    assert len({material.base_color for material, _ in drawn}) == len({period_m for _, period_m in drawn}) == 200
    assert all(PERIOD_M[0] <= period_m <= PERIOD_M[1] and 0.8 <= one.roughness <= 1.0 for one, period_m in drawn)
    assert all(0.1 < c <= 1.0 for material, _ in drawn for c in material.base_color[:3])
