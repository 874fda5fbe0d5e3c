"""What is read of good files: the same geometry of every format, colours, materials, pictures, and where things stand."""

import base64
import io
import math
import struct
import warnings
import zlib
from dataclasses import replace
from urllib.parse import quote

import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.job.assets import CATEGORIES, MeshLimits, ProceduralSource
from schemas.scene.shape import Material, Part, Shape
from tests.kit.shapes import asset_of
from tests.workers.door.mutants import exported, png_of
from tests.workers.door.oracles import (
    CUBE,
    gltf,
    picture,
    textured_cube,
    textured_obj,
    urdf,
    visual,
    welded,
    write,
    write_all,
)
from workers.assets.builtin.make import make_asset
from workers.assets.glb import asset_glb, read_shape
from workers.door.meshes.formats import list_mesh_files, load_shape
from workers.door.meshes.mesh import is_solid
from workers.door.meshes.urdf import load_posed
from workers.door.opening import split_glb

NORMALS = "not drawn: normalTexture"
"""The note on the map of the glTF cube that nothing reads."""


def load(path, **limits):
    return load_shape(path, MeshLimits(**limits))


def only_part(path, **limits):
    """The one part of a file, of which nothing was left out."""
    loaded = load(path, **limits)
    (part,) = loaded.shape.parts
    assert set(loaded.notes) <= {NORMALS}
    return part


def test_every_geometry_of_a_scene_stands_where_its_node_puts_it_and_mirrored_ones_face_outwards(tmp_path):
    scene, mirror = trimesh.Scene(), np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[:3, 3] = (-5, 0, 0)
    scene.add_geometry(trimesh.creation.box((1, 2, 3)), node_name="a", geom_name="g")
    scene.graph.update(frame_to="b", frame_from="world", matrix=mirror, geometry="g")
    shape = load(write(tmp_path / "scene.glb", exported(scene, "glb"))).shape
    assert is_solid(shape.vertices, shape.faces) and welded(shape).volume == pytest.approx(12.0, rel=1e-6)
    assert shape.bounds == pytest.approx(np.array([[-5.5, -1, -1.5], [0.5, 1, 1.5]]))
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    scene = trimesh.Scene()
    scene.add_geometry(sheet, transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    part = load(write(tmp_path / "sheet.glb", exported(scene, "glb"))).shape.parts[0]
    a, b, c = part.vertices[part.faces[0]]
    assert np.cross(b - a, c - a) == pytest.approx([0, 0, 1]), "a mirrored sheet still faces the same way"


# ------------------------------------------------------------------------------------------------ what a file refers to


def test_files_are_listed_with_all_that_they_refer_to_and_nothing_outside_the_folder(tmp_path):
    write_all(tmp_path / "m", textured_obj("../t/a.png", more="map_Kd none.png\n"))
    write(tmp_path / "m/more.obj", b"# xmtllib no.mtl\r\nmtllib cube.mtl\r\nv 0 0 0\nmtllib last one.mtl")
    write(
        tmp_path / "m/last one.mtl", "newmtl a\nmap_Kd \\\\server\\..\\skin.png\nmap_Kd /abs/b.png\nmap_Kd bad\0.png\n"
    )
    write_all(tmp_path / "m", gltf())
    write(tmp_path / "m/a.ply", "ply\nformat ascii 1.0\ncomment TextureFile skin.png\nend_header\n")
    for name in ("t/a.png", "m/skin.png", "m/b.png"):
        write(tmp_path / name, picture())
    for first, others in (
        ("cube.obj", ["m/cube.mtl", "t/a.png"]),
        ("more.obj", ["m/cube.mtl", "m/last one.mtl", "t/a.png", "m/skin.png", "m/b.png"]),
        ("cube.gltf", ["m/cube.bin", "m/skin.png"]),
        ("a.ply", ["m/skin.png"]),
    ):
        files = list_mesh_files(tmp_path / "m" / first, tmp_path, MeshLimits())
        assert [file.relative_to(tmp_path).as_posix() for file in files] == [f"m/{first}", *others]
    assert len(list_mesh_files(tmp_path / "m/cube.obj", tmp_path / "m", MeshLimits())) == 2
    write_all(
        tmp_path / "n", {"a.obj": b"mtllib gone.mtl\n", "a.mtl": b"newmtl a\nmap_Kd skin.png\n", "skin.png": picture()}
    )
    assert [file.name for file in list_mesh_files(tmp_path / "n/a.obj", tmp_path / "n", MeshLimits())] == [
        *("a.obj", "a.mtl", "skin.png")
    ], "what stands in for a missing material file is a file of the mesh"


def test_a_texture_outside_the_root_is_not_read(tmp_path):
    write(tmp_path / "secret.png", picture())
    path = textured_cube(tmp_path / "inner", picture="../secret.png")
    assert load(path).shape.parts[0].material.texture is None
    assert load_shape(path, MeshLimits(), root=tmp_path).shape.parts[0].material.texture is not None
    (tmp_path / "inner" / "link.png").symlink_to(tmp_path / "secret.png")
    assert load(textured_cube(tmp_path / "inner", picture="link.png")).shape.parts[0].material.texture is None


def bomb() -> bytes:
    """A header that promises 10,000 x 10,000 pixels: Pillow warns from 89 million on, and refuses only twice as many."""
    return png_of(struct.pack(">IIBBBBB", 10000, 10000, 8, 2, 0, 0, 0), zlib.compress(b""))


NOISE = picture("PNG", (64, 64), None), picture("JPEG", (64, 64), None)
PICTURES = {
    "none.png": (None, "none.png is missing"),
    "../outside.png": (None, "../outside.png is missing"),
    "/etc/hostname": (None, "/etc/hostname is missing"),
    "words.png": (b"no picture", "is no picture that can be read"),
    "skin.ktx2": (b"\xabKTX 20\xbb", "is a KTX picture"),
    "large.png": (picture(size=(2049, 1)), "over max_texture_px = 2048"),
    "bomb.png": (bomb(), "cannot be opened"),
    "half.png": (NOISE[0][: len(NOISE[0]) // 2], "cannot be decoded"),
    "half.jpg": (NOISE[1][: len(NOISE[1]) // 2], "cannot be decoded"),
}
"""A picture's name and bytes, and what the note on it says."""


def test_a_picture_that_cannot_be_had_is_a_note_and_the_mesh_stays(tmp_path):
    write(tmp_path / "outside.png", picture())
    names = {**PICTURES, "http://example.org/a.png": (None, ""), "file:///etc/hostname": (None, "")}
    for name, (data, says) in names.items():
        if data is not None:
            write(tmp_path / "in" / name, data)
        limits = {"max_texture_px": 100_000 if name == "bomb.png" else 2048}
        for files in (textured_obj(name), gltf(picture=name)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                loaded = load(write_all(tmp_path / "in", files), **limits)
            (note,) = set(loaded.notes) - {NORMALS}
            assert says in note and note.endswith("plain base colour used") and " at 0x" not in note, (name, note)
            assert loaded.shape.parts[0].material.texture is None and loaded.shape.closed
    assert "is an address" in note, "of a glTF file"
    write(tmp_path / "in/skin.png", picture(size=(MeshLimits().max_texture_px, 2)))
    part = only_part(textured_cube(tmp_path / "in"))
    assert part.material.texture.shape == (2, MeshLimits().max_texture_px, 3), "as large as the cap allows"


def test_data_within_the_file_and_names_with_escapes_are_read_and_what_is_no_colour_is_not_asked_for(tmp_path):
    inside = "data:application/octet-stream;base64," + base64.b64encode(gltf()["cube.bin"]).decode()
    data = "data:image/png;base64," + base64.b64encode(picture(colour=(0, 0, 255))).decode()
    write(tmp_path / "my skin ü.png", picture())
    for files, colour in (
        (gltf(buffer=inside, picture=data), [0, 0, 255]),
        (gltf(picture=quote("my skin ü.png")), [255, 0, 0]),
    ):
        part = only_part(write_all(tmp_path, files))
        assert part.material.texture.tolist() == [[colour] * 4] * 4
        assert part.vertices.min() == -0.5 and part.vertices.max() == 0.5 and len(part.faces) == 12


# ------------------------------------------------------------------------------------------------ materials and colours


def test_a_texture_comes_along_with_its_coordinates_right_way_up_and_its_alpha(tmp_path):
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[0, :, 0], pixels[-1, :, 2] = 255, 255
    Image.fromarray(pixels).save(tmp_path / "skin.png")
    part = only_part(textured_cube(tmp_path))
    assert part.material.texture.tolist() == pixels.tolist() and part.material.base_color == (1.0, 1.0, 1.0, 1.0)
    assert sorted(map(tuple, np.unique(part.uv, axis=0))) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    Image.fromarray(np.full((2, 2, 4), 77, np.uint8)).save(tmp_path / "skin.png")
    part = only_part(textured_cube(tmp_path, more="d 0.5\n"))
    assert part.material.texture.shape == (2, 2, 4) and part.material.base_color[3] == 0.5


def test_a_jpeg_is_stored_as_it_is_and_once(tmp_path):
    data = picture("JPEG", (64, 64), None)
    write(tmp_path / "skin.jpg", data)
    files = textured_obj("skin.jpg")
    half = files["cube.obj"].replace(b"\nf 4/1", b"\nusemtl other\nf 4/1")
    path = write_all(
        tmp_path, files | {"cube.obj": half, "cube.mtl": files["cube.mtl"] + b"newmtl other\nmap_Kd skin.jpg\n"}
    )
    parts = load(path).shape.parts
    assert [part.material.jpeg for part in parts] == [data, data]
    stored = asset_glb(replace(asset_of(trimesh.creation.box((1, 1, 1))), shape=Shape(parts[:1])))
    assert read_shape(stored)[0].parts[0].material.jpeg == data
    assert data in stored and split_glb(stored)[0]["images"][0]["mimeType"] == "image/jpeg"
    again = load(write(tmp_path / "b.glb", stored)).shape.parts[0].material
    assert again.texture.tolist() == parts[0].material.texture.tolist() and again.jpeg == data


# ------------------------------------------------------------------------------------------------ URDF


def load_body(folder, text, **limits):
    return load_posed(write(folder / "a.urdf", text), MeshLimits(**limits), folder).shape


def test_visuals_are_scaled_then_turned_then_shifted_about_the_fixed_axes(tmp_path):
    write(tmp_path / "cube.obj", CUBE)
    origin = f'<origin xyz="10 0 0" rpy="0 0 {math.pi / 2}"/>'
    for name in ("cube.obj", "package://thing/cube.obj", ".\\cube.obj"):
        shape = load_body(tmp_path, urdf(visual(f'<mesh filename="{name}" scale="1 2 3"/>', origin)))
        # x goes to y and y to -x: [0, 1] x [0, 2] x [0, 3] becomes [-2, 0] x [0, 1] x [0, 3], then x is moved by 10.
        assert shape.bounds == pytest.approx(np.array([[8, 0, 0], [10, 1, 3]]))
        assert welded(shape).volume == pytest.approx(6.0)
    turned = load_body(
        tmp_path,
        '<?xml version="0.0"?><!-- fine -->' + urdf(visual('<box size="2 4 6"/>', '<origin rpy="0.3 0.5 0.7"/>')),
    )
    expected = trimesh.creation.box((2, 4, 6), transform=trimesh.transformations.euler_matrix(0.3, 0.5, 0.7, "sxyz"))
    assert turned.bounds == pytest.approx(expected.bounds)


def test_links_stand_where_their_joints_put_them(tmp_path):
    joint = '<joint name="{0}{1}" type="fixed"><parent link="{0}"/><child link="{1}"/>'
    joint += '<origin xyz="0 0 2" rpy="{2} 0 0"/></joint>'
    box = visual('<box size="1 1 1"/>')
    links = "".join(f'<link name="{name}">{box}</link>' for name in "abc")
    shape = load_body(
        tmp_path, f'<robot name="r">{links}{joint.format("b", "c", 0)}{joint.format("a", "b", math.pi / 2)}</robot>'
    )
    # b stands 2 above a and is turned about x: its own up, along which c stands 2 further, is -y.
    middles = np.array([part.vertices.mean(axis=0) for part in shape.parts])
    assert middles == pytest.approx(np.array([[0, 0, 0], [0, 0, 2], [0, -2, 2]]), abs=1e-12)


def test_numbers_of_a_urdf_may_have_commas_between_them_as_robots_parsers_let_them(tmp_path):
    part = load_body(tmp_path, urdf(visual('<box size="1.0, 2.0, 3"/>'))).parts[0]
    assert np.ptp(part.vertices, axis=0) == pytest.approx([1.0, 2.0, 3.0])


def test_the_colour_of_the_urdf_goes_on_what_brings_none(tmp_path):
    own, named = '<material name="m"><color rgba="1 0.2 0 1"/></material>', '<material name="m"/>'
    box = '<box size="1 1 1"/>'
    for text in (urdf(visual(box, material=own)), urdf(visual(box, material=named), more=own)):
        assert load_body(tmp_path, text).parts[0].material.base_color == (1.0, 0.2, 0.0, 1.0)
    textured_cube(tmp_path)
    write(tmp_path / "skin.png", picture())
    part = load_body(tmp_path, urdf(visual('<mesh filename="cube.obj"/>', material=own))).parts[0]
    assert part.material.texture is not None and part.material.base_color == (1.0, 1.0, 1.0, 1.0)


# ------------------------------------------------------------------------------------------------ what a dataset stores


def test_a_stored_glb_holds_the_same_shape_for_another_library_and_for_the_door(tmp_path):
    for category in (*CATEGORIES, "table"):
        asset = make_asset(category, ProceduralSource(source="procedural"), 3, 600.0)
        data = asset_glb(asset)
        assert data == asset_glb(make_asset(category, ProceduralSource(source="procedural"), 3, 600.0))
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
        ours = load(write(tmp_path / "a.glb", data)).shape
        assert is_solid(ours.vertices, ours.faces)
        for part, mesh, again in zip(asset.shape.parts, scene.geometry.values(), ours.parts, strict=True):
            assert mesh.vertex_normals == pytest.approx(part.normals, abs=1e-6)
            assert len(mesh.faces) == len(part.faces)
            assert again.vertices == pytest.approx(part.vertices, abs=1e-7)
            assert again.material.base_color == pytest.approx(part.material.base_color, abs=0.01)
        assert scene.bounds == pytest.approx(asset.shape.bounds, abs=1e-7)
    tree, binary = split_glb(data)
    assert "z up" in tree["asset"]["extras"]["frame"] and tree["asset"]["copyright"] == "CC0-1.0"
    assert struct.unpack_from("<I", data, 8)[0] == len(data) and len(binary) == tree["buffers"][0]["byteLength"]


def test_texture_coordinates_alpha_and_vertex_colours_of_a_stored_glb_come_back(tmp_path):
    pixels, uv = np.random.default_rng(0).integers(0, 255, (4, 8, 4), np.uint8), np.random.default_rng(1).random((3, 2))
    triangle, face = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]], np.int32)
    colors = np.array([[255, 0, 0, 255], [0, 128, 0, 255], [3, 20, 255, 128]], np.uint8)
    textured = Part("t", triangle, face, Material(texture=pixels, base_color=(1, 1, 1, 0.5)), uv=uv)
    colored = Part("c", triangle + 2, face, Material((1, 1, 1, 1)), colors=colors)
    asset = replace(asset_of(trimesh.creation.box((1, 1, 1))), shape=Shape((textured, colored)))
    one, two = load(write(tmp_path / "x.glb", asset_glb(asset))).shape.parts
    assert one.material.texture.tolist() == pixels.tolist() and one.uv == pytest.approx(uv, abs=1e-6)
    assert one.material.base_color[3] == pytest.approx(0.5, abs=0.01)
    assert np.abs(two.colors.astype(int) - colors.astype(int)).max() <= 1
