"""GLB files, read back with trimesh."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.job.assets import CATEGORIES, MeshLimits, ProceduralSource
from schemas.scene.shape import Material, Part, Shape
from tests.kit.shapes import asset_of
from tests.workers.assets.oracles import welded, write
from workers.assets.builtin.make import make_asset
from workers.assets.external.formats import load_shape
from workers.assets.external.mesh import is_solid
from workers.assets.glb import asset_glb

SOURCE = ProceduralSource(source="procedural")


def read(data):
    return trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)


@pytest.mark.parametrize("category", [*CATEGORIES, "table"])
def test_the_file_holds_the_same_geometry_in_the_object_frame(category):
    asset = make_asset(category, SOURCE, 3, 600.0)
    scene = read(asset_glb(asset))
    meshes = list(scene.geometry.values())
    for part, mesh in zip(asset.shape.parts, meshes, strict=True):
        assert mesh.vertex_normals == pytest.approx(part.normals, abs=1e-6)
    assert sum(len(mesh.faces) for mesh in meshes) == len(asset.shape.faces)
    assert scene.bounds == pytest.approx(asset.shape.bounds, abs=1e-7)
    assert sum(mesh.area for mesh in meshes) == pytest.approx(welded(asset.shape).area, rel=1e-5)


def test_the_file_passes_the_door_and_is_closed_as_it_was(tmp_path):
    asset = make_asset("mug", SOURCE, 1, 600.0)
    loaded = load_shape(write(tmp_path / "mug.glb", asset_glb(asset)), MeshLimits())
    assert is_solid(loaded.shape.vertices, loaded.shape.faces)
    assert welded(loaded.shape).volume == pytest.approx(asset.volume_m3, rel=1e-5)
    by_name = zip(asset.shape.parts, loaded.shape.parts, strict=True)
    for part, again in by_name:
        assert again.vertices == pytest.approx(part.vertices, abs=1e-7)
        assert again.material.base_color == pytest.approx(part.material.base_color, abs=0.01)
        assert again.normals == pytest.approx(part.normals, abs=1e-5)


def test_the_same_asset_gives_the_same_bytes():
    one, two = (asset_glb(make_asset("can", SOURCE, 7, 600.0)) for _ in range(2))
    assert one == two


def test_the_file_says_that_z_is_up():
    data = asset_glb(make_asset("box", SOURCE, 0, 600.0))
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    assert "z up" in tree["asset"]["extras"]["frame"]
    assert tree["asset"]["copyright"] == "CC0-1.0"
    assert struct.unpack_from("<I", data, 8)[0] == len(data)


def test_texture_coordinates_alpha_and_vertex_colours_come_back(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (4, 8, 4), dtype=np.uint8)
    uv = np.random.default_rng(1).random((3, 2))
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    textured = Part(
        "t", triangle, frozen_array([[0, 1, 2]], np.int32), Material(texture=pixels, base_color=(1, 1, 1, 0.5)), uv=uv
    )
    colors = np.array([[255, 0, 0, 255], [0, 128, 0, 255], [3, 20, 255, 128]], np.uint8)
    colored = Part("c", triangle + 2, frozen_array([[0, 1, 2]], np.int32), Material((1, 1, 1, 1)), colors=colors)
    asset = asset_of(trimesh.creation.box((1, 1, 1)))
    object.__setattr__(asset, "shape", Shape((textured, colored)))
    loaded = load_shape(write(tmp_path / "x.glb", asset_glb(asset)), MeshLimits()).shape.parts
    assert loaded[0].material.texture.tolist() == pixels.tolist()
    assert loaded[0].uv == pytest.approx(uv, abs=1e-6)
    assert loaded[0].material.base_color[3] == pytest.approx(0.5, abs=0.01)
    assert np.abs(loaded[1].colors.astype(int) - colors.astype(int)).max() <= 1
