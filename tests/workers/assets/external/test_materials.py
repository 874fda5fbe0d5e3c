"""Materials and colours of mesh files."""

import numpy as np
import pytest
import trimesh
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from schemas.job.assets import MeshLimits
from tests.workers.assets.oracles import write
from workers.assets.external.formats import load_shape, read_visual
from workers.assets.external.mesh import DEFAULT


def box_with(material):
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    return mesh


def test_gltf_colours_are_linear_and_become_srgb(tmp_path):
    skin = PBRMaterial(baseColorFactor=[0.2158605, 1, 0, 0.5], metallicFactor=0.25)
    path = write(tmp_path / "a.glb", box_with(skin).export(file_type="glb"))
    material = load_shape(path, MeshLimits()).shape.parts[0].material
    assert material.base_color == pytest.approx((0.5028, 1.0, 0.0, 0.5), abs=0.005)
    assert material.metallic == 0.25
    assert material.roughness == 1.0  # what glTF means by leaving it out


def test_a_shiny_mtl_is_smoother_than_a_dull_one():
    dull, shiny = (read_visual(box_with(SimpleMaterial(glossiness=g)))[0].material for g in (2.0, 900.0))
    assert dull.roughness == pytest.approx((2 / 4) ** 0.25)
    assert shiny.roughness < 0.3 < dull.roughness


def test_an_alpha_of_zero_is_read_as_one_and_told():
    visual, notes = read_visual(box_with(SimpleMaterial(diffuse=[0.5, 0.5, 0.5], d=["0.0"])))
    assert visual.material.base_color[3] == 1.0
    assert notes == ("an alpha of 0 was read as 1",)


def test_colours_of_vertices_and_of_faces_are_kept_and_a_bare_mesh_has_the_default():
    mesh = trimesh.creation.box((1, 1, 1))
    assert read_visual(mesh)[0].material is DEFAULT
    mesh.visual.vertex_colors = np.tile([255, 0, 128, 255], (8, 1)).astype(np.uint8)
    assert read_visual(mesh)[0].colors[0].tolist() == [255, 0, 128, 255]
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.visual.face_colors = np.tile([10, 20, 30, 255], (12, 1)).astype(np.uint8)
    assert read_visual(mesh)[0].face_colors.shape == (12, 4)
