"""Files that ended whole jobs, or never ended: each is refused with its reason, or does no harm, beside a good one."""

import json
import struct

import numpy as np
import pytest
from PIL import Image

from schemas.job.assets import Assets, FolderSource, MeshLimits
from schemas.job.job import Job
from tests.workers.assets.oracles import CUBE, textured_cube, write
from workers.assets.catalogue import open_catalogue
from workers.assets.external import urdf as urdf_file
from workers.assets.external.formats import load_shape
from workers.assets.external.urdf import load_urdf
from workers.scene.plan import SceneChance, draw_scene

PLY = """ply
format ascii 1.0
comment TextureFile skin.png
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""


def visual(geometry, more=""):
    return f"<visual>{more}<geometry>{geometry}</geometry></visual>"


def urdf(*visuals, more=""):
    return f'<robot name="r"><link name="l">{"".join(visuals)}</link>{more}</robot>'


def chain(count):
    links = "".join(f'<link name="{k}">{visual(BOX)}</link>' for k in range(count))
    joint = '<joint name="j{0}"><parent link="{0}"/><child link="{1}"/></joint>'
    return f'<robot name="r">{links}{"".join(joint.format(k, k + 1) for k in range(count - 1))}</robot>'


def glb(tree, binary=b""):
    text = (tree if isinstance(tree, str) else json.dumps(tree)).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def nested_nodes(count):
    nodes = [{"children": [k + 1]} for k in range(count - 1)] + [{"mesh": 0}]
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]], "<f4").tobytes()
    return glb(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "buffers": [{"byteLength": 36}],
        },
        triangle,
    )


BOX = '<box size="0.1 0.1 0.1"/>'
MESH = '<mesh filename="cube.obj"{}/>'

CASES = {
    "triangle.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "no_hull"),
    "line.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nv 2 1e-5 0\nf 1 2 3\nf 1 3 4\n", "no_hull"),
    "box.urdf": (urdf(visual('<box size="1e300 1 1"/>')), "not_finite"),
    "scale.urdf": (urdf(visual(MESH.format(' scale="1e300 1 1"'))), "not_finite"),
    "all.urdf": (urdf(visual(MESH.format(' scale="1e300 1e300 1e300"'))), "not_finite"),
    "cylinder.urdf": (urdf(visual('<cylinder radius="1e200" length="1"/>')), "not_finite"),
    "shift.urdf": (urdf(visual(BOX, '<origin xyz="1e308 0 0"/>')), "not_finite"),
    "atom.urdf": (urdf(visual('<box size="1e-9 1e-9 1e-9"/>')), "size"),
    "world.urdf": (urdf(visual('<box size="1e9 1e9 1e9"/>')), "not_finite"),
    "house.urdf": (urdf(visual('<box size="20 1 1"/>')), "size"),
    "count.glb": (glb('{"accessors": [{"count": 1e400}]}'), "unreadable"),
    "digits.glb": (glb('{"accessors": [{"count": ' + "9" * 4000 + "}]}"), "unreadable"),
    "deep.glb": (glb("[" * 100_000), "unreadable"),
    "texture.ply": (PLY, "no_hull"),
    "chain.urdf": (chain(20_000), "too_large"),
    "chain_of_300.urdf": (chain(300), "unreadable"),
    "visuals.urdf": (urdf(visual(BOX) * 20_000), "too_large"),
    "references.urdf": (urdf(visual(MESH.format("")) * 10_000), "too_large"),
    "nodes.glb": (nested_nodes(100_000), "too_large"),
}


def opened(folder, *names, limits=None):
    source = FolderSource(source="urdf", folder=str(folder), category_map=dict.fromkeys(names, "mug"))
    return open_catalogue(Assets(objects=(source,), limits=limits or MeshLimits()), folder, ("mug",))


@pytest.mark.parametrize("name", CASES)
def test_a_file_that_ended_the_job_is_left_out_by_name_and_the_good_one_beside_it_is_used(tmp_path, name):
    content, reason = CASES[name]
    write(tmp_path / "cube.obj", CUBE)
    write(tmp_path / "skin.png", b"\x89PNG\r\n\x1a\n and no more")
    write(tmp_path / name, content)
    catalogue = opened(tmp_path, name, "cube.obj")
    assert catalogue.skipped == {str(tmp_path): {reason: 1}}
    (example,) = catalogue.examples(str(tmp_path))
    assert example.startswith(f"{name} ({reason}: ") and example.isprintable()
    for seed in range(20):
        assert catalogue.draw(0, "mug", np.random.default_rng(seed)).instance_id.startswith("cube-")
    scene_of(catalogue, "cube.obj")


def scene_of(catalogue, path):
    """The plan of a scene with this asset, without which an asset is of no use."""
    entries = catalogue.objects[0].entries["mug"]
    (index,) = (k for k, entry in enumerate(entries) if entry.files[0].path == path)
    asset, table = catalogue.load(catalogue.refer(0, "mug", index)), catalogue.load(catalogue.refer(0, "table", 0))
    plan = draw_scene(Job(name="t", categories={"mug": 1}), SceneChance(1, 0), table, asset)
    return asset, plan


@pytest.mark.parametrize("library", ["a" * 100_000, "a/" * 50_000, "/dev/zero", "..", "a\x01b", "~root/x.mtl"])
def test_a_strange_name_of_a_material_file_is_a_note_in_one_line_or_nothing(tmp_path, library):
    write(tmp_path / "a.obj", f"mtllib {library}\nusemtl x\n" + CUBE)
    asset, _ = scene_of(opened(tmp_path, "a.obj"), "a.obj")
    assert asset.watertight and all(note.isprintable() and len(note) < 1100 for note in asset.notes)


def test_a_mesh_that_a_urdf_names_a_thousand_times_is_read_once(tmp_path, monkeypatch):
    write(tmp_path / "cube.obj", CUBE)
    path = write(tmp_path / "a.urdf", urdf(visual(MESH.format(' scale="0.1 0.1 0.1"')) * 1000))
    read = []
    monkeypatch.setattr(urdf_file, "load_shape", lambda *given: read.append(given) or load_shape(*given))
    assert len(load_urdf(path, MeshLimits(), tmp_path).shape.faces) == 12_000
    assert len(read) == 1


@pytest.mark.parametrize("text", ["map_Kd skin.png\n" * 100_000, "".join(f"map_Kd {k}.png\n" for k in range(100_000))])
def test_a_material_file_that_names_pictures_without_end_is_read_for_as_long_as_a_mesh_may_have_parts(tmp_path, text):
    """Took 30 s of processor time and more."""
    textured_cube(tmp_path, more=text)
    Image.new("RGB", (8, 8)).save(tmp_path / "skin.png")
    catalogue = opened(tmp_path, "cube.obj", limits=MeshLimits(max_cpu_s=8))
    asset, _ = scene_of(catalogue, "cube.obj")
    assert len(asset.notes) <= 20


def test_all_textures_of_an_asset_together_have_a_cap(tmp_path):
    """Each is within `max_texture_px`; without the cap, a hundred like them took 9.8 GB."""
    materials = "".join(f"newmtl m{k}\nKd 1 1 1\nmap_Kd skin{k}.png\n" for k in range(4))
    mesh = textured_cube(tmp_path)
    faces = [line for line in mesh.read_text().splitlines() if line.startswith("f ")]
    others = [line for line in mesh.read_text().splitlines() if not line.startswith("f ")]
    mesh.write_text("\n".join([*others, *(f"usemtl m{k}\n{face}" for k, face in enumerate(faces[:4]))]) + "\n")
    write(tmp_path / "cube.mtl", materials)
    for k in range(4):
        Image.new("RGB", (1000, 1000), (k, 0, 0)).save(tmp_path / f"skin{k}.png")
    loaded = load_shape(mesh, MeshLimits(max_textures_mpx=2.5))
    assert sum(part.material.texture is not None for part in loaded.shape.parts) == 2
    assert sum("over max_textures_mpx = 2.5 with the textures before it" in note for note in loaded.notes) == 2
    assert load_shape(mesh, MeshLimits()).notes == ()


def test_all_files_of_an_asset_together_have_a_cap(tmp_path):
    textured_cube(tmp_path)
    noise = np.random.default_rng(0).integers(0, 255, (500, 500, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "skin.png")
    write(tmp_path / "good.obj", CUBE)
    catalogue = opened(tmp_path, "cube.obj", "good.obj", limits=MeshLimits(max_asset_mb=0.5))
    assert catalogue.skipped == {str(tmp_path): {"too_large": 1}}
    assert "over max_asset_mb = 0.5" in catalogue.examples(str(tmp_path))[0]


def test_a_file_name_that_no_table_can_hold_is_left_out(tmp_path):
    write(tmp_path / "good.obj", CUBE)
    (tmp_path / "bad\udcff.obj").write_text(CUBE)
    source = FolderSource(source="urdf", folder=str(tmp_path), category_map={"*.obj": "mug"})
    catalogue = open_catalogue(Assets(objects=(source,)), tmp_path, ("mug",))
    assert catalogue.skipped == {str(tmp_path): {"name": 1}}
    assert catalogue.offers("mug")[0][2] == 1
