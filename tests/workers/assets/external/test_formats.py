"""What a mesh file may hold and refer to: counts, material files, textures, colours."""

import io
import struct
import warnings
import zlib

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from schemas.job.assets import MeshLimits
from tests.workers.assets.oracles import CUBE, textured_cube, write
from workers.assets.external.caps import FolderResolver, declared_counts
from workers.assets.external.formats import list_mesh_files, load_shape, material_files, read_visual
from workers.assets.external.mesh import DEFAULT


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
def test_the_counts_that_a_file_declares_are_those_that_it_holds(suffix):
    mesh = trimesh.creation.icosphere(2)
    vertices, faces = declared_counts(suffix, mesh.export(file_type=suffix[1:]))
    assert faces == len(mesh.faces)
    assert vertices in (len(mesh.vertices), 3 * len(mesh.faces))


def load(path, **limits):
    return load_shape(path, MeshLimits(**limits))


def test_names_with_backslashes_and_folders_that_do_not_exist_are_found_beside_the_mesh(tmp_path):
    write(tmp_path / "mesh" / "skin.png", b"\x89PNG")
    resolver = FolderResolver(tmp_path / "mesh" / "a.obj", tmp_path, MeshLimits())
    for name in ("skin.png", ".\\skin.png", "C:\\home\\skin.png", "/abs/skin.png"):
        assert resolver.find(name) == tmp_path / "mesh" / "skin.png"
    assert resolver.find("../../etc/passwd") is None
    assert resolver.find("bad\0name") is None


def test_a_texture_comes_along_with_its_coordinates_right_way_up(tmp_path):
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[0, :, 0], pixels[-1, :, 2] = 255, 255
    Image.fromarray(pixels).save(tmp_path / "skin.png")
    part = load(textured_cube(tmp_path)).shape.parts[0]
    assert part.material.texture.tolist() == pixels.tolist()
    assert part.material.base_color == (1.0, 1.0, 1.0, 1.0)
    assert sorted(map(tuple, np.unique(part.uv, axis=0))) == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_alpha_is_kept(tmp_path):
    Image.fromarray(np.full((2, 2, 4), 77, np.uint8)).save(tmp_path / "skin.png")
    part = load(textured_cube(tmp_path, more="d 0.5\n")).shape.parts[0]
    assert part.material.texture.shape == (2, 2, 4)
    assert part.material.base_color[3] == 0.5


@pytest.mark.parametrize("name", ["skin.gif", "skin.png"])
def test_a_texture_that_is_no_png_or_jpeg_is_refused_whatever_its_name(tmp_path, name):
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / name, format="GIF")
    loaded = load(textured_cube(tmp_path, picture=name))
    assert loaded.shape.parts[0].material.texture is None
    assert "not a PNG or JPEG" in loaded.notes[0]


def test_a_decompression_bomb_is_not_opened(tmp_path):
    # A header that promises 10,000 x 10,000 pixels: Pillow warns from 89 million on, and refuses only twice as many.
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 10000, 10000, 8, 2, 0, 0, 0))
    write(tmp_path / "skin.png", bomb + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = load_shape(textured_cube(tmp_path), MeshLimits(max_texture_px=100_000))
    assert loaded.shape.parts[0].material.texture is None
    assert "cannot be opened" in loaded.notes[0]


def test_a_texture_over_the_cap_is_refused(tmp_path):
    Image.fromarray(np.zeros((2, 65, 3), np.uint8)).save(tmp_path / "skin.png")
    loaded = load(textured_cube(tmp_path), max_texture_px=64)
    assert loaded.shape.parts[0].material.texture is None
    assert "over max_texture_px" in loaded.notes[0]


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_texture_whose_data_ends_early_leaves_the_base_colour_and_a_note(tmp_path, suffix):
    """Its header is whole, so that it is found out only where it is decoded."""
    stream = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(stream, {"png": "PNG", "jpg": "JPEG"}[suffix])
    (tmp_path / f"skin.{suffix}").write_bytes(stream.getvalue()[: len(stream.getvalue()) // 2])
    loaded = load(textured_cube(tmp_path, picture=f"skin.{suffix}"))
    assert loaded.shape.parts[0].material.texture is None
    assert len(loaded.shape.faces) == 12
    assert "cannot be decoded" in loaded.notes[0] and " at 0x" not in loaded.notes[0]


def test_a_texture_as_large_as_the_cap_allows_comes_along(tmp_path):
    side = MeshLimits().max_texture_px
    Image.new("L", (side, 2), 99).save(tmp_path / "skin.png")
    loaded = load(textured_cube(tmp_path))
    assert loaded.shape.parts[0].material.texture.shape == (2, side, 3)
    assert loaded.notes == ()


def test_a_texture_outside_the_root_is_not_read(tmp_path):
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "secret.png")
    path = textured_cube(tmp_path / "inner", picture="../secret.png")
    assert load(path).shape.parts[0].material.texture is None
    assert load_shape(path, MeshLimits(), root=tmp_path).shape.parts[0].material.texture is not None
    (tmp_path / "inner" / "link.png").symlink_to(tmp_path / "secret.png")
    path = textured_cube(tmp_path / "inner", picture="link.png")
    assert load(path).shape.parts[0].material.texture is None


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


def test_material_files_are_found_wherever_they_are_named():
    text = b"# xmtllib no\r\nmtllib a b.mtl\r\nv 0 0 0\nmtllib c.mtl\n"
    assert material_files(text) == ["a b.mtl", "c.mtl"]
    assert material_files(b"mtllib first.mtl") == ["first.mtl"]


def test_an_obj_comes_with_its_materials_and_their_textures(tmp_path):
    write(tmp_path / "m" / "cube.obj", "mtllib cube.mtl\n" + CUBE)
    write(tmp_path / "m" / "cube.mtl", "newmtl a\nmap_Kd ../t/a.png\nnewmtl b\nmap_Kd none.png\n")
    write(tmp_path / "t" / "a.png", b"png")
    files = list_mesh_files(tmp_path / "m" / "cube.obj", tmp_path, MeshLimits())
    assert [file.relative_to(tmp_path).as_posix() for file in files] == ["m/cube.obj", "m/cube.mtl", "t/a.png"]
