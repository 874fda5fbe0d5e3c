"""Materials: within what glTF allows."""

import numpy as np

from workers.assets.builtin import materials


def test_materials_are_within_what_gltf_allows():
    rng = np.random.default_rng(2)
    for draw in (materials.plastic, materials.steel, materials.metal):
        for _ in range(100):
            material = draw(rng)
            assert 0.0 <= material.metallic <= 1.0
            assert 0.05 <= material.roughness <= 1.0
            assert material.base_color[3] == 1.0
