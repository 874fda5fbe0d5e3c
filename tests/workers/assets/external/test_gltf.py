"""glTF files with buffers and pictures of their own, and what a stranger may write into them."""

import base64
import io
import json
from urllib.parse import quote

import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from tests.workers.assets.external.test_hostile_files import opened, scene_of
from tests.workers.assets.oracles import CUBE, write
from workers.assets.external.formats import load_shape
from workers.assets.external.gltf import named_by_gltf


def png(size=(4, 4), colour=(255, 0, 0)):
    stream = io.BytesIO()
    Image.new("RGB", size, colour).save(stream, "PNG")
    return stream.getvalue()


def gltf(folder, name="cube.gltf", buffer="cube.bin", picture="skin.png", **changes):
    """A unit cube whose corners, faces and texture coordinates lie in one buffer, written by hand after the specification."""
    mesh = trimesh.creation.box((1, 1, 1))
    blocks = [mesh.vertices.astype("<f4").tobytes(), mesh.faces.astype("<u2").tobytes()]
    blocks.append(np.random.default_rng(0).random((8, 2)).astype("<f4").tobytes())
    starts = np.cumsum([0, *map(len, blocks)])
    views = [{"buffer": 0, "byteOffset": int(s), "byteLength": len(b)} for s, b in zip(starts, blocks, strict=False)]
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 1}, "metallicRoughnessTexture": {"index": 0}},
                "normalTexture": {"index": 0},
            }
        ],
        "images": [{"uri": "no such normal map.png"}, {"uri": picture}],
        "textures": [{"source": 0}, {"source": 1}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 8, "type": "VEC2"},
        ],
        "bufferViews": views,
        "buffers": [{"uri": buffer, "byteLength": int(starts[-1])}],
        **changes,
    }
    write(folder / "cube.bin", b"".join(blocks))
    return write(folder / name, json.dumps(tree))


def test_buffers_and_pictures_beside_it_are_read_and_what_is_no_colour_is_not_asked_for(tmp_path):
    write(tmp_path / "skin.png", png())
    loaded = load_shape(gltf(tmp_path), MeshLimits())
    assert loaded.notes == ()
    assert loaded.shape.bounds.tolist() == [[-0.5] * 3, [0.5] * 3] and len(loaded.shape.faces) == 12
    assert loaded.shape.closed
    assert loaded.shape.parts[0].material.texture.tolist() == [[[255, 0, 0]] * 4] * 4


def test_a_glb_of_the_same_mesh_gives_the_same_shape(tmp_path):
    mesh = trimesh.creation.annulus(0.2, 0.5, 1.0)
    mesh.visual = trimesh.visual.TextureVisuals(
        np.random.default_rng(1).random((len(mesh.vertices), 2)),
        trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), (9, 8, 7)), roughnessFactor=0.25),
    )
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
        write(tmp_path / name, data)
    ours = load_shape(tmp_path / "model.gltf", MeshLimits()).shape
    (part,), (theirs,) = (
        ours.parts,
        load_shape(write(tmp_path / "m.glb", mesh.export(file_type="glb")), MeshLimits()).shape.parts,
    )
    assert np.array_equal(part.vertices, theirs.vertices) and np.array_equal(part.faces, theirs.faces)
    assert np.array_equal(part.uv, theirs.uv) and np.array_equal(part.material.texture, theirs.material.texture)
    assert (part.material.roughness, part.material.base_color) == (
        theirs.material.roughness,
        theirs.material.base_color,
    )


def test_data_within_the_file_and_names_with_escapes_are_read(tmp_path):
    gltf(tmp_path)
    inside = "data:application/octet-stream;base64," + base64.b64encode((tmp_path / "cube.bin").read_bytes()).decode()
    picture = "data:image/png;base64," + base64.b64encode(png(colour=(0, 0, 255))).decode()
    loaded = load_shape(gltf(tmp_path, "inside.gltf", inside, picture), MeshLimits())
    assert loaded.shape.parts[0].material.texture[0, 0].tolist() == [0, 0, 255]
    write(tmp_path / "my skin ü.png", png())
    loaded = load_shape(gltf(tmp_path, picture=quote("my skin ü.png")), MeshLimits())
    assert loaded.notes == () and loaded.shape.parts[0].material.texture is not None


@pytest.mark.parametrize(
    ("picture", "why"),
    [
        ("none.png", "none.png is missing"),
        ("../outside.png", "../outside.png is missing"),
        ("/etc/hostname", "/etc/hostname is missing"),
        ("http://example.org/a.png", "is an address"),
        ("file:///etc/hostname", "is an address"),
        ("cube.bin", "is not a PNG or JPEG"),
        ("large.png", "over max_texture_px = 64"),
    ],
)
def test_a_picture_that_cannot_be_had_is_a_note_and_the_mesh_stays(tmp_path, picture, why):
    write(tmp_path / "outside.png", png())
    write(tmp_path / "in/large.png", png((65, 1)))
    loaded = load_shape(gltf(tmp_path / "in", picture=picture), MeshLimits(max_texture_px=64))
    (note,) = loaded.notes
    assert why in note and note.endswith("plain base colour used")
    assert loaded.shape.parts[0].material.texture is None and loaded.shape.closed


def views(**change):
    return {"bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 96, **change}]}


def bad(reason, says, limits=None, **changes):
    return reason, says, limits or {}, changes


HOSTILE = {
    "no_buffer": bad("missing", "none.bin is missing", buffer="none.bin"),
    "above": bad("missing", "is missing", buffer="../above.bin"),
    "device": bad("missing", "is missing", buffer="/dev/zero"),
    "address": bad("missing", "is an address", buffer="https://example.org/cube.bin"),
    "long_name": bad("missing", "is missing", buffer="a/" * 50_000),
    "large": bad("too_large", "max_file_mb", limits={"max_file_mb": 0.002}, buffer="huge.bin"),
    "together": bad("too_large", "max_asset_mb", limits={"max_asset_mb": 0.002}, buffer="huge.bin"),
    "no_base64": bad("unreadable", "base64", buffer="data:application/octet-stream;base64,???"),
    "odd_data": bad("unreadable", "base64", buffer="data:text/plain,abc"),
    "short": bad("unreadable", "declares", buffers=[{"uri": "cube.bin", "byteLength": 10**15}]),
    "negative": bad("unreadable", "declares", buffers=[{"uri": "cube.bin", "byteLength": -1}]),
    "no_uri": bad("unreadable", "without a file", buffers=[{"byteLength": 5}]),
    "view": bad("unreadable", "beyond its buffer", **views(byteLength=10**9)),
    "before": bad("unreadable", "beyond its buffer", **views(byteOffset=-8)),
    "wrong": bad("unreadable", "IndexError", **views(buffer=7)),
    "version": bad("unreadable", "only 2.x", asset={"version": "1.0"}),
    "no_asset": bad("unreadable", "no `asset`", asset=None),
    "draco": bad("format", "export it without", extensionsRequired=["KHR_draco_mesh_compression"]),
    "count": bad("unreadable", "promises", accessors=[{"count": 10**12, "componentType": 5126, "type": "VEC3"}] * 3),
    "cycle": bad("unreadable", "two parents", nodes=[{"mesh": 0, "children": [1, 1]}, {}]),
    "many": bad("too_large", "max_nodes", nodes=[{"mesh": 0}] * 5000),
    "texture": bad("unreadable", "IndexError", images=[]),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused_by_name_and_the_good_one_beside_it_is_used(tmp_path, name):
    reason, says, limits, changes = HOSTILE[name]
    write(tmp_path / "above.bin", b"x" * 5000)
    folder = tmp_path / "in"
    write(folder / "huge.bin", b"x" * 5000)
    write(folder / "skin.png", png())
    path = gltf(folder, f"{name}.gltf", **changes)
    with pytest.raises(MeshError) as caught:
        load_shape(path, MeshLimits(**limits), folder)
    assert (caught.value.reason, says in caught.value.detail) == (reason, True), caught.value.detail
    assert len(caught.value.detail) < 1500
    write(folder / "good.obj", CUBE)
    catalogue = opened(folder, path.name, "good.obj", limits=MeshLimits(**limits))
    assert catalogue.skipped == {str(folder): {reason: 1}}
    assert catalogue.examples(str(folder))[0].startswith(f"{name}.gltf ({reason}: ")
    assert catalogue.offers("mug")[0][2] == 1


@pytest.mark.parametrize(
    "text", ["", "[", "[" * 100_000, "7", '{"asset": {"version": "2.0"}, "buffers": 3}', '{"a": 1e999}']
)
def test_what_is_no_gltf_is_refused_in_one_line(tmp_path, text):
    path = write(tmp_path / "a.gltf", text)
    for read in (lambda: load_shape(path, MeshLimits()), lambda: named_by_gltf(path, path.read_bytes())):
        with pytest.raises(MeshError) as caught:
            read()
        assert caught.value.reason == "unreadable" and "\n" not in caught.value.detail


def test_a_change_in_a_buffer_or_a_picture_is_another_catalogue(tmp_path):
    write(tmp_path / "skin.png", png())
    gltf(tmp_path)
    before = opened(tmp_path, "cube.gltf")
    (entry,) = before.objects[0].entries["mug"]
    assert [file.path for file in entry.files] == ["cube.gltf", "cube.bin", "skin.png"]
    asset, _ = scene_of(before, "cube.gltf")
    assert asset.watertight and asset.notes == ()
    write(tmp_path / "skin.png", png(colour=(0, 255, 0)))
    assert opened(tmp_path, "cube.gltf").digest != before.digest
    with pytest.raises(MeshError, match="has changed"):
        before.load(before.refer(0, "mug", 0))
