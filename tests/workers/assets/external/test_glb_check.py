"""GLB files, checked before they are parsed."""

import io

import numpy as np
import trimesh
from PIL import Image

from schemas.job.assets import MeshLimits
from tests.workers.assets.oracles import write
from workers.assets.external.mesh import load_shape


def load(path, **limits):
    return load_shape(path, MeshLimits(**limits))


def test_a_glb_picture_of_another_kind_is_left_out_and_the_mesh_stays(tmp_path):
    uv = np.random.default_rng(0).random((8, 2))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), (255, 0, 0)))
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    data = mesh.export(file_type="glb")
    good = load(write(tmp_path / "good.glb", data))
    assert good.shape.parts[0].material.texture.shape == (4, 4, 3)
    stream = io.BytesIO()
    Image.new("RGB", (4, 4), (255, 0, 0)).save(stream, "PNG")
    assert data.count(b"\x89PNG") == 1
    loaded = load(write(tmp_path / "bad.glb", data.replace(b"\x89PNG", b"GIF8")))
    assert loaded.shape.parts[0].material.texture is None
    assert len(loaded.shape.faces) == 12
    assert "not a PNG or JPEG" in loaded.notes[0]
