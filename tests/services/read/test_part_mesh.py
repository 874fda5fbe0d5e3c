"""A part keeps its corners, its faces and its colour as a mesh of trimesh's."""

import numpy as np
import pytest

from schemas.job.assets import ProceduralSource
from services.read.scene_geometry import mesh_of_part
from workers.assets.builtin.make import make_asset


@pytest.mark.parametrize("category", ["mug", "laptop", "table"])
def test_a_mesh_is_its_part(category):
    asset = make_asset(category, ProceduralSource(source="procedural"), 3, 500.0)
    for part in asset.shape.parts:
        mesh = mesh_of_part(part)
        assert np.array_equal(mesh.vertices, part.vertices) and np.array_equal(mesh.faces, part.faces)
        if part.material.texture is None and part.colors is None:
            found = np.asarray(mesh.visual.material.baseColorFactor) / 255
            srgb = np.array(part.material.base_color[:3])
            linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
            assert found[:3] == pytest.approx(linear, abs=0.5 / 255 + 1e-9)
        elif part.material.texture is not None:
            assert np.array_equal(np.asarray(mesh.visual.material.baseColorTexture), part.material.texture)
