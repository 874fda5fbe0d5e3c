"""Hostile and broken files: each is refused with its reason, or does no harm, beside a good one; and thousands of mutants."""

import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.errors import MeshError
from schemas.job.assets import Assets, LibrarySource, MeshLimits
from schemas.job.job import Job
from schemas.scene.shape import Asset
from tests.workers.assets.libraries import library_of, open_folder
from tests.workers.door.mutants import mutant
from tests.workers.door.oracles import CUBE, glb, gltf, picture, textured_cube, urdf, visual, write, write_all
from tests.workers.door.test_statements import dae
from workers.assets.catalogue import ignore, open_catalogue
from workers.assets.library.collection import SUFFIXES, survey_folder
from workers.assets.library.shapes import load_shape as load_shape_of
from workers.assets.library.shapes import make_shapes
from workers.assets.library.table import Library, Row
from workers.door.meshes import urdf as urdf_file
from workers.door.meshes.formats import load_shape
from workers.door.meshes.urdf import load_posed
from workers.pool import Answers
from workers.scene.chance import SceneChance
from workers.scene.context import open_worker
from workers.scene.draw.plan import draw_scene
from workers.shard.run_shard import run_scene
from workers.stopwatch import Stopwatch

PLY = """ply
format ascii 1.0
comment TextureFile damaged.png
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
HUGE_PLY = (
    "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nelement face 1\nend_header\n"
)
DAE = dae(node="<instance_node url='#n'/>")["a.dae"].decode()
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
BOX = '<box size="0.1 0.1 0.1"/>'
MESH = '<mesh filename="cube.obj"{}/>'
ENTITIES = '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot name="r"><link name="&b;"/></robot>'


def chain(count: int, start: int = 0, circle: bool = False) -> str:
    """A URDF of links that hang on one another."""
    links = "".join(f'<link name="{k}">{visual(BOX)}</link>' for k in range(count))
    joint = '<joint name="j{0}"><parent link="{0}"/><child link="{1}"/></joint>'
    ends = "".join(joint.format(k, k + 1) for k in range(count - 1)) + (joint.format(count - 1, 0) if circle else "")
    return f'<robot name="r">{links}{ends}</robot>'


def nested_nodes(count: int) -> bytes:
    """A GLB of a triangle below many nodes."""
    nodes = [{"children": [k + 1]} for k in range(count - 1)] + [{"mesh": 0}]
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }
    return glb(tree, np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]], "<f4").tobytes())


def view(**change):
    """Changes of a glTF file: its first view of a buffer."""
    return {"bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 96, **change}]}


HOSTILE = {
    # What no file can be
    "none.obj": (None, "missing", "No such file"),
    "scene.fbx": ("<x/>", "format", "is not one of"),
    "empty.obj": ("", "no_faces", "is empty"),
    # OBJ, PLY and STL
    "index.obj": (TRIANGLE + "f 1 2 9\n", "index_out_of_range", "a face names"),
    "nan.obj": ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not_finite", "not a finite number"),
    "inf.obj": ("v 0 0 inf\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not_finite", "not a finite number"),
    "far.obj": ("v 0 0 1e30\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not_finite", "over 1e+07"),
    "points.obj": (TRIANGLE, "no_faces", "has no triangles"),
    "edges.obj": (TRIANGLE + "f 1 2\nf 3\n", "no_faces", "has no triangles"),
    "collapsed.obj": (TRIANGLE + "f 1 1 2\n", "no_faces", "only empty faces"),
    "needle.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no_faces", "only faces without area"),
    "words.obj": ("v 0 0 0\nf a b c\n", "unreadable", "that is not numbers"),
    "triangle.obj": (TRIANGLE + "f 1 2 3\n", "no_hull", "four points apart"),
    "line.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nv 2 1e-5 0\nf 1 2 3\nf 1 3 4\n", "no_hull", "four points apart"),
    "texture.ply": (PLY, "no_hull", "four points apart"),
    "huge.ply": (HUGE_PLY, "unreadable", "promises 4000000000 elements"),
    # OFF
    "short.off": ("OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "unreadable", "1 of 2 faces"),
    "index.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "index_out_of_range", "a face names"),
    "negative.off": ("OFF\n-3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "unreadable", ""),
    "huge.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n99999999999 0 1 2\n", "unreadable", ""),
    "words.off": ("OFF\n3 1 0\n0 0 x\n1 0 0\n0 1 0\n3 0 1 2\n", "unreadable", ""),
    # COLLADA
    "entities.dae": ("<!DOCTYPE x><COLLADA/>", "unreadable", "document type or entities"),
    "other.dae": ("<x/>", "unreadable", "its root is <x>"),
    "empty_scene.dae": (
        "<COLLADA><library_visual_scenes><visual_scene/></library_visual_scenes></COLLADA>",
        "no_faces",
        "",
    ),
    "no_scene.dae": ("<COLLADA/>", "no_faces", "has no scene"),
    "words.dae": (DAE.replace("<p>0", "<p>a"), "unreadable", "invalid literal"),
    "index.dae": (DAE.replace("<p>0", "<p>9"), "index_out_of_range", "a face names"),
    "input.dae": (DAE.replace('offset="1"', 'offset="2"'), "unreadable", ""),
    "array.dae": (DAE.replace("#p-a", "#q-a"), "format", "which is not in it"),
    "loop.dae": (
        DAE.replace("</node></library_nodes>", "<instance_node url='#n'/></node></library_nodes>"),
        "unreadable",
        "",
    ),
    # URDF
    "box.urdf": (urdf(visual('<box size="1e300 1 1"/>')), "not_finite", "over 1e+07"),
    "scale.urdf": (urdf(visual(MESH.format(' scale="1e300 1 1"'))), "not_finite", ""),
    "all.urdf": (urdf(visual(MESH.format(' scale="1e300 1e300 1e300"'))), "not_finite", ""),
    "cylinder.urdf": (urdf(visual('<cylinder radius="1e200" length="1"/>')), "not_finite", ""),
    "shift.urdf": (urdf(visual(BOX, '<origin xyz="1e308 0 0"/>')), "not_finite", ""),
    "flat.urdf": (urdf(visual(MESH.format(' scale="1 0 1"'))), "no_size", "scales a mesh"),
    "atom.urdf": (urdf(visual('<box size="1e-9 1e-9 1e-9"/>')), "size", "under min_size_m"),
    "world.urdf": (urdf(visual('<box size="1e9 1e9 1e9"/>')), "not_finite", "over 1e+07"),
    "house.urdf": (urdf(visual('<box size="20 1 1"/>')), "size", "over max_size_m"),
    "bare.urdf": (urdf(), "no_faces", "no visual geometry"),
    "nothing.urdf": (urdf(visual("")), "unreadable", "a visual without geometry"),
    "letters.urdf": (urdf(visual('<box size="1 x 1"/>')), "unreadable", "is not 3 positive numbers"),
    "negative.urdf": (urdf(visual('<box size="1 -1 1"/>')), "unreadable", "is not 3 positive numbers"),
    "torus.urdf": (urdf(visual("<torus/>")), "unreadable", "geometry <torus> is not known"),
    "gone.urdf": (urdf(visual('<mesh filename="gone.obj"/>')), "missing", "names 'gone.obj'"),
    "above.urdf": (urdf(visual('<mesh filename="../above.obj"/>')), "missing", "is not inside"),
    "address.urdf": (urdf(visual('<mesh filename="file:///etc/hostname"/>')), "missing", "is not inside"),
    "chain.urdf": (chain(20_000), "too_large", "20000 links, over max_nodes"),
    "chain_of_300.urdf": (chain(300), "unreadable", "more than 256"),
    "circle.urdf": (chain(2, circle=True), "unreadable", "go round in a circle"),
    "visuals.urdf": (urdf(visual(BOX) * 20_000), "too_large", "20000 visuals, over max_nodes"),
    "references.urdf": (urdf(visual(MESH.format("")) * 10_000), "too_large", "10000 visuals, over max_nodes"),
    "entities.urdf": (ENTITIES, "unreadable", "document type or entities"),
    "wide.urdf": (ENTITIES.encode("utf-16"), "unreadable", "document type or entities"),
    "sdf.urdf": ("<sdf/>", "unreadable", "its root is <sdf>"),
    "text.urdf": ("no xml", "unreadable", "is not XML"),
    "open.urdf": ("<robot>", "unreadable", "is not XML"),
    # GLB and glTF: bytes
    "count.glb": (glb('{"accessors": [{"count": 1e400}]}'), "unreadable", "no `asset`"),
    "digits.glb": (glb('{"accessors": [{"count": ' + "9" * 4000 + "}]}"), "unreadable", "no `asset`"),
    "deep.glb": (glb("[" * 100_000), "unreadable", "is not a glb file that can be read"),
    "nodes.glb": (nested_nodes(100_000), "too_large", "over max_nodes"),
    "empty.gltf": ("", "no_faces", "is empty"),
    "open.gltf": ("[", "unreadable", "is not a gltf file that can be read"),
    "deep.gltf": ("[" * 100_000, "unreadable", "is not a gltf file that can be read"),
    "number.gltf": ("7", "unreadable", "no `asset`"),
    "buffers.gltf": ('{"asset": {"version": "2.0"}, "buffers": 3}', "unreadable", "TypeError"),
    # glTF: changes of a good one
    "no_buffer.gltf": ({"buffer": "none.bin"}, "missing", "its buffer none.bin is missing"),
    "above.gltf": ({"buffer": "../above.bin"}, "missing", "is missing"),
    "device.gltf": ({"buffer": "/dev/zero"}, "missing", "is missing"),
    "address.gltf": ({"buffer": "https://example.org/cube.bin"}, "missing", "is an address"),
    "long_name.gltf": ({"buffer": "a/" * 50_000}, "missing", "is missing"),
    "no_base64.gltf": ({"buffer": "data:application/octet-stream;base64,???"}, "unreadable", "base64"),
    "odd_data.gltf": ({"buffer": "data:text/plain,abc"}, "unreadable", "base64"),
    "short.gltf": ({"buffers": [{"uri": "cube.bin", "byteLength": 10**15}]}, "unreadable", "declares"),
    "negative.gltf": ({"buffers": [{"uri": "cube.bin", "byteLength": -1}]}, "unreadable", "declares"),
    "no_uri.gltf": ({"buffers": [{"byteLength": 5}]}, "unreadable", "without a file"),
    "view.gltf": (view(byteLength=10**9), "unreadable", "beyond its buffer"),
    "before.gltf": (view(byteOffset=-8), "unreadable", "beyond its buffer"),
    "wrong.gltf": (view(buffer=7), "unreadable", "IndexError"),
    "version.gltf": ({"asset": {"version": "1.0"}}, "format", "only 2.x is read: export it as glTF 2.0"),
    "no_asset.gltf": ({"asset": None}, "unreadable", "no `asset`"),
    "draco.gltf": ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "format", "export it without"),
    "promises.gltf": (
        {"accessors": [{"count": 10**12, "componentType": 5126, "type": "VEC3"}]},
        "unreadable",
        "promises",
    ),
    "cycle.gltf": ({"nodes": [{"mesh": 0, "children": [1, 1]}, {}]}, "unreadable", "two parents"),
    "many.gltf": ({"nodes": [{"mesh": 0}] * 5000}, "too_large", "max_nodes"),
    "texture.gltf": ({"images": []}, "unreadable", "IndexError"),
}
"""What is in a file (of glTF also what is other than in a good one), why it is refused, and words that say so."""


def hostile_folder(folder: Path) -> Path:
    """All of these files in one folder, good ones beside them, and things above it that they name."""
    write(folder / "above.bin", b"x" * 5000)
    write(folder / "above.obj", CUBE)
    inside = folder / "in"
    write(inside / "cube.obj", CUBE)
    write(inside / "skin.png", picture())
    write(inside / "damaged.png", b"\x89PNG\r\n\x1a\n and no more")
    for name, (content, _, _) in HOSTILE.items():
        if isinstance(content, dict):
            write_all(inside, gltf(name, **content))
        elif content is not None:
            write(inside / name, content)
    return inside


def outcomes(folder: Path, paths: list[Path], limits: MeshLimits) -> list[Asset | MeshError]:
    """Each file surveyed and made as a library does: why it is refused, or the asset that is read of its GLB."""
    names = [path.relative_to(folder).as_posix() for path in paths]
    surveys = survey_folder(folder, names, limits, Answers(None), ignore)
    library = Library(folder.parent / "made", folder, limits, ())
    rows, answers = dict[str, Row](), dict[str, Asset | MeshError]()
    for survey in surveys:
        assert all((folder / file.path).resolve().is_relative_to(folder.resolve()) for file in survey.files)
        if survey.measured is None:
            answers[survey.path] = MeshError(survey.refused[0], f"{survey.path}: {survey.refused[1]}")
        else:
            rows[survey.path] = Row(survey.path, category="mug", files=survey.files)
    settings = LibrarySource(source="library", folder=".")
    for row, made in make_shapes(library, rows.values()):
        answers[row.path] = (
            made if isinstance(made, MeshError) else load_shape_of(library, row, settings, Assets(), row.instance_id)
        )
    return [answers[name] for name in names]


def check_refusal(error: MeshError, what: str) -> None:
    """It names its file in one line, and is no fault of the machine."""
    assert error.kind == "intrinsic", (what, error)
    assert error.detail.isprintable() and len(error.detail) < 1100, (what, error)


def test_every_hostile_file_is_refused_with_its_reason_in_one_line(tmp_path):
    folder = hostile_folder(tmp_path)
    answers = outcomes(folder, [folder / name for name in (*HOSTILE, "cube.obj")], MeshLimits())
    assert isinstance(answers.pop(), Asset), "the good one beside them"
    for (name, (_, reason, says)), answer in zip(HOSTILE.items(), answers, strict=True):
        assert isinstance(answer, MeshError), name
        assert answer.reason == reason and says in answer.detail and name in answer.detail, (name, str(answer))
        check_refusal(answer, name)


def scene_of(catalogue, path):
    """The asset, and the plan of a scene with it, without which an asset is of no use."""
    entries = catalogue.objects[0].entries["mug"]
    (index,) = (k for k, entry in enumerate(entries) if entry.path == path)
    asset, table = catalogue.load(catalogue.refer(0, "mug", index)), catalogue.load(catalogue.refer(0, "table", 0))
    return asset, draw_scene(Job(name="t", categories={"mug": 1}), SceneChance(1, 0), table, asset)


def test_what_is_refused_is_left_out_of_a_job_by_name_and_the_good_one_beside_it_is_used(tmp_path):
    folder = hostile_folder(tmp_path)
    (folder / "bad\udcff.obj").write_text(CUBE)
    catalogue = open_folder(folder)
    (library,) = catalogue.libraries()
    left_out = {row.path: row.reason for row in library.rows if not row.use}
    read = {name for name, (content, _, _) in HOSTILE.items() if content is not None and Path(name).suffix in SUFFIXES}
    assert all(left_out[name] in (HOSTILE[name][1], "part", "copy", "name", "link") for name in read)
    assert left_out["bad\\udcff.obj"] == "name"
    (told,) = catalogue.describe_left_out()
    assert told.isprintable() and len(library.examples) == 3
    draws = {catalogue.draw(0, "mug", np.random.default_rng(seed)).instance_id[:5] for seed in range(20)}
    assert draws == {"cube-"}
    scene_of(catalogue, "cube.obj")


CAPS = (
    ({"max_vertices": 7}, "8 vertices, over max_vertices = 7"),
    ({"max_faces": 5}, "6 faces, over max_faces = 5"),
    ({"max_file_mb": 1e-5}, "over max_file_mb = 1e-05"),
    ({"max_asset_mb": 1e-5}, "over max_asset_mb = 1e-05"),
)


def refusal(path: Path, **limits) -> str:
    """Why a file is too large."""
    with pytest.raises(MeshError) as caught:
        (load_posed if path.suffix == ".urdf" else load_shape)(path, MeshLimits(**limits), path.parent)
    assert caught.value.reason == "too_large"
    return caught.value.detail


def test_what_is_over_a_cap_is_refused_before_it_is_parsed_and_what_is_not_is_read(tmp_path):
    cube = write(tmp_path / "cube.obj", CUBE)
    for limits, says in CAPS:
        assert says in refusal(cube, **limits)
    boxes = write(tmp_path / "a.urdf", urdf(visual(BOX) * 3))
    assert "36 faces" in refusal(boxes, max_faces=35) and load_posed(boxes, MeshLimits(max_faces=36), tmp_path)
    shown = write_all(tmp_path, gltf(nodes=[{"mesh": 0}] * 20, scenes=[{"nodes": list(range(20))}]))
    assert "240 faces" in refusal(shown, max_faces=239), "counted each time that a node shows it"
    assert len(load_shape(shown, MeshLimits(max_faces=240)).shape.faces) == 12, "and what lies in one place is one"
    for limits in ({"max_file_mb": 0.002}, {"max_asset_mb": 0.002}):
        write(tmp_path / "huge.bin", b"x" * 5000)
        assert next(iter(limits)) in refusal(write_all(tmp_path, gltf(buffer="huge.bin")), **limits)


def test_all_files_and_all_textures_of_an_asset_together_have_caps(tmp_path):
    """Each texture is within `max_texture_px`; without the cap, a hundred like them took 9.8 GB."""
    mesh = textured_cube(tmp_path)
    faces = [line for line in mesh.read_text().splitlines() if line.startswith("f ")]
    others = [line for line in mesh.read_text().splitlines() if not line.startswith("f ")]
    mesh.write_text("\n".join([*others, *(f"usemtl m{k}\n{face}" for k, face in enumerate(faces[:4]))]) + "\n")
    write(tmp_path / "cube.mtl", "".join(f"newmtl m{k}\nKd 1 1 1\nmap_Kd skin{k}.png\n" for k in range(4)))
    for k in range(4):
        write(tmp_path / f"skin{k}.png", picture(size=(1000, 1000), colour=(k, 0, 0)))
    loaded = load_shape(mesh, MeshLimits(max_textures_mpx=2.5))
    assert sum(part.material.texture is not None for part in loaded.shape.parts) == 2
    assert sum("over max_textures_mpx = 2.5 with the textures before it" in note for note in loaded.notes) == 2
    assert load_shape(mesh, MeshLimits()).notes == ()
    write(tmp_path / "skin0.png", picture(size=(500, 500), colour=None))
    write(tmp_path / "good.obj", CUBE)
    (library,) = open_folder(tmp_path, limits=MeshLimits(max_asset_mb=0.5)).libraries()
    (cube,) = [row for row in library.rows if row.path == "cube.obj"]
    assert (cube.use, cube.reason) == (False, "too_large") and "over max_asset_mb = 0.5" in cube.why


def test_strange_names_of_material_files_are_notes_in_one_line_or_nothing(tmp_path):
    names = ("a" * 100_000, "a/" * 50_000, "/dev/zero", "..", "a\x01b", "~root/x.mtl")
    for number, library in enumerate(names):
        write(tmp_path / f"{number}.obj", f"mtllib {library}\nusemtl x\n" + CUBE)
    catalogue = open_folder(tmp_path)
    for number in range(len(names)):
        asset, _ = scene_of(catalogue, f"{number}.obj")
        assert asset.watertight and all(note.isprintable() and len(note) < 1100 for note in asset.notes)


def test_a_mesh_that_a_urdf_names_a_thousand_times_is_read_once(tmp_path, monkeypatch):
    write(tmp_path / "cube.obj", CUBE)
    path = write(tmp_path / "a.urdf", urdf(visual(MESH.format(' scale="0.1 0.1 0.1"')) * 1000))
    read = []
    monkeypatch.setattr(urdf_file, "load_shape", lambda *given: read.append(given) or load_shape(*given))
    assert len(load_posed(path, MeshLimits(), tmp_path).shape.faces) == 12_000
    assert len(read) == 1


@pytest.mark.minute
@pytest.mark.parametrize("text", ["map_Kd skin.png\n" * 100_000, "".join(f"map_Kd {k}.png\n" for k in range(100_000))])
def test_a_material_file_that_names_pictures_without_end_is_read_for_as_long_as_a_mesh_may_have_parts(tmp_path, text):
    """Took 30 s of processor time and more."""
    textured_cube(tmp_path, more=text)
    Image.new("RGB", (8, 8)).save(tmp_path / "skin.png")
    asset, _ = scene_of(open_folder(tmp_path, limits=MeshLimits(max_cpu_s=8)), "cube.obj")
    assert len(asset.notes) <= 20


# ------------------------------------------------------------------------------------------------ mutants

MOST_S = 10
"""Processor seconds within which each mutant is listed, checked or loaded."""
REASONS = {
    "format", "index_out_of_range", "missing", "name", "no_faces", "no_hull", "no_size", "not_finite", "read", "size",
    "too_large", "unreadable",
}  # fmt: skip


def check_asset(asset: Asset, what: str) -> None:
    """Finite and in range, centred, no larger than allowed, and weighed as its volume or area says."""
    vertices, faces = asset.shape.vertices, asset.shape.faces
    assert np.isfinite(vertices).all() and faces.min() >= 0 and faces.max() < len(vertices), what
    size, limits = float(np.linalg.norm(asset.extents_m)), MeshLimits()
    assert limits.min_size_m * 0.999 <= size <= limits.max_size_m * 1.001, what
    assert np.abs(asset.shape.bounds.sum(axis=0)).max() <= 1e-6 * size, what
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    if asset.watertight:
        volume = float((a * np.cross(b, c)).sum() / 6.0)
        weight = asset.mass.mass_kg / 600.0
        if weight < 0.999 * volume:  # bodies that overlap weigh once, but for those that touch in a point
            bodies = [trimesh.Trimesh(part.vertices, part.faces) for part in asset.shape.parts]
            united = trimesh.boolean.union([body.process(merge_tex=True, merge_norm=True) for body in bodies])
            assert 0.999 * united.volume <= weight <= volume, what
        else:
            assert weight == pytest.approx(volume, rel=1e-3, abs=1e-9 * size**3), what
    else:
        area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)
        assert asset.mass.mass_kg == pytest.approx(3.0 * area, rel=1e-3), what
    assert asset.mass.mass_kg > 0.0 and np.isfinite(asset.mass.inertia).all(), what
    assert len(asset.notes) <= 20 and all(note.isprintable() for note in asset.notes), what


def read_mutants(folder: Path, indices: range) -> Counter[str]:
    """How many mutants were read, or refused for each reason; each is sound, or one line that names it."""
    made = [mutant(index) for index in indices]
    paths = [write_all(folder / str(index), files) for index, (_, files) in zip(indices, made, strict=True)]
    found: Counter[str] = Counter()
    for (what, _), path, answer in zip(made, paths, outcomes(folder, paths, MeshLimits(max_cpu_s=MOST_S)), strict=True):
        if isinstance(answer, MeshError):
            check_refusal(answer, what)
            assert path.name in answer.detail or str(path.parent) in answer.detail, (what, answer)
            assert answer.reason in REASONS, f"nothing is too slow, or unknown: {path}, {what}, {answer}"
        else:
            check_asset(answer, what)
        found["read" if isinstance(answer, Asset) else answer.reason] += 1
    return found


@pytest.mark.minute
def test_some_mutants_are_read_or_refused_and_nothing_else(tmp_path):
    assert {"read", "unreadable"} < set(read_mutants(tmp_path, range(30)))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", range(12))
def test_thousands_of_mutants_are_read_or_refused_and_nothing_else(tmp_path, part, capsys):
    begun = time.monotonic()
    found = read_mutants(tmp_path, range(300 * part, 300 * (part + 1)))
    with capsys.disabled():
        print(f"\n{dict(found.most_common())} in {time.monotonic() - begun:.0f} s")


@pytest.mark.parametrize(
    ("mutants", "scenes"),
    [
        pytest.param(24, 2, marks=pytest.mark.minute),
        pytest.param(400, 100, marks=(pytest.mark.slow, pytest.mark.timeout(1800))),
    ],
)
def test_scenes_of_accepted_mutants_are_made_or_say_why_not(tmp_path, mutants, scenes):
    for index in range(mutants):
        write_all(tmp_path / "in" / f"{index:04}", mutant(index)[1])
    source = library_of(tmp_path / "in")
    job = Job.model_validate({"name": "t", "categories": {"mug": 1}, "seed": 5, "assets": {"objects": [source]}})
    context = open_worker(job, open_catalogue(job.assets, tmp_path, ("mug",)))
    found: Counter[str] = Counter()
    for scene_id in range(scenes):
        rows = run_scene(context, scene_id, Stopwatch()).rows.get("failures", [])
        found.update([f"{row['stage']}: {row['reason']}" for row in rows] or ["made"])
    assert not [outcome for outcome in found if outcome.startswith("assets")]
    assert found.total() == scenes and found["made"] >= scenes / 5
