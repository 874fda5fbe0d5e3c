"""`verso init`: a folder of meshes becomes a library, a page of pictures and a job; and docs/own_meshes.md, which is run."""

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.dataset as ds
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import verso
from schemas.errors import AssetSourceError, MachineError, plural
from schemas.job.assets import MeshLimits, ProceduralSource
from services.cli.main import main
from services.init import command, shown
from services.init.shown import (
    HEADINGS,
    MOST_ROWS,
    TILE,
    cells_of,
    draw_left_out,
    draw_object,
    draw_sheet,
    draw_table,
    notes_of,
)
from services.job.job_file import load_job, validate_job
from tests.services.init.own_meshes import cup, mixed_folder, write_mesh, write_textured
from tests.workers.door.oracles import write
from workers.assets.builtin.make import make_asset
from workers.assets.catalogue import open_catalogue
from workers.assets.library import collection
from workers.assets.library.collection import OUTSIDE, SUFFIXES, walk_folder
from workers.assets.library.copies import find_copies
from workers.assets.library.placement import find_unit
from workers.assets.library.reading import list_files
from workers.assets.library.table import PLAIN, Row, read_table
from workers.door.meshes.mesh import transform_shape
from workers.geometry.frames import pose
from workers.render.raster.gbuffer import shared_renderer

SMALL_SENSOR = {"width": 48, "height": 48, "fx": 52, "fy": 52, "cx": 24, "cy": 24}
ROOT = Path(__file__).resolve().parents[3]


def init(*words, capsys):
    code = main(["init", *map(str, words)])
    told = capsys.readouterr()
    return code, told.out, told.err


@pytest.mark.minute
def test_a_mixed_folder_becomes_a_library_and_a_job_that_offers_exactly_what_was_shown(tmp_path, capsys):
    folder, out = mixed_folder(tmp_path / "mixed meshes"), tmp_path / "lib"
    code, told, _ = init(folder, "--out", out, "--json", capsys=capsys)
    answer = json.loads(told.splitlines()[-1])
    assert (code, answer["ok"], answer["job"], answer["sheet"]) == (
        0,
        True,
        str(out / "job.yaml"),
        str(out / "sheet.jpg"),
    )
    assert (
        f"verso run {out}/job.yaml --scenes 8" in told
        and "robot/collision.obj and 1 more (part): part of robot" in told
    )

    job = load_job(out / "job.yaml")
    catalogue = open_catalogue(job.assets, out, tuple(job.categories))
    (library,) = catalogue.libraries()
    offered = {row.path: row.category for row in library.rows if row.use and row.category}
    assert offered == {one["path"]: one["category"] for one in answer["objects"]} and len(offered) == 10
    categories = {"002_can", "bottles", "gltf-cup", "mugs", "robot", "standing", "table_mesh"}
    assert set(offered.values()) == set(job.categories) == categories
    assert library.doubts == {"standing.glb": "z"}, "one against the specification, which is told"
    heights = {row.path: row.extents_m[2] for row in library.rows if row.extents_m}
    true = {"mugs/mug_2.glb": 0.12, "standing.glb": 0.08, "bottles/bottle 0.stl": 0.2, "gltf cup/model.gltf": 0.1}
    assert {path: heights[path] for path in true} == pytest.approx(true, abs=1e-6)
    loaded = {
        row.path: catalogue.load(catalogue.refer(0, row.category, k))
        for c in library.entries.values()
        for k, row in enumerate(c)
        if row.use
    }
    assert all(loaded[row.path].mass.mass_kg == row.mass_kg for row in library.rows if row.use and row.category)
    left_out = {one["path"]: (one["reason"], one["why"]) for one in answer["left_out"]}
    assert left_out.pop("broken.obj")[0] == "index_out_of_range"
    assert left_out.pop("huge.stl")[1].startswith("is too large for a table: 1.73e+03 m at 0.001 m a unit; change")
    assert left_out == {
        "002_can/google_16k/nontextured.ply": ("copy", "double of 002_can/copy/textured.obj"),
        "002_can/google_16k/textured.obj": ("copy", "double of 002_can/copy/textured.obj"),
        "mugs/out.glb": ("link", OUTSIDE),
        "robot/collision.obj": ("part", "part of robot/model.urdf"),
        "robot/textured.obj": ("part", "part of robot/model.urdf"),
        "scene.fbx": ("format", ".fbx is not read: run `assimp export FILE FILE.glb`, or use Blender"),
        "torn.gltf": ("missing", "its buffer gone.bin is missing"),
    }
    with Image.open(out / "sheet.jpg") as page:
        assert page.size[0] > 1500 and np.asarray(page).std() > 20
    before = {path: path.read_bytes() for path in (*out.glob("shapes/*"), out / "job.yaml", out / "library.parquet")}
    assert init(folder, "--out", out, capsys=capsys)[0] == 0
    assert before == {path: path.read_bytes() for path in before}, "once more, the same"


def test_the_job_follows_the_library_until_a_person_changes_it(tmp_path, capsys):
    folder, job = tmp_path / "meshes", tmp_path / "lib/job.yaml"
    for name, size in (("cup", 0.1), ("box", 0.2)):
        (folder / name).mkdir(parents=True)
        trimesh.creation.box((size, 0.1, 0.15)).export(folder / name / "a.obj")
    assert init(folder, "--out", tmp_path / "lib", capsys=capsys)[0] == 0
    assert set(load_job(job).categories) == {"cup", "box"}
    (folder / "box").rename(folder / "crate")
    assert "was changed" not in "".join(map(str, init(folder, "--out", tmp_path / "lib", capsys=capsys)))
    assert set(load_job(job).categories) == {"cup", "crate"}, "as it was not changed"
    job.write_text(mine := job.read_text().replace("seed: 1", "seed: 2"))
    (folder / "cup").rename(folder / "mug")
    told = " ".join(map(str, init(folder, "--out", tmp_path / "lib", capsys=capsys)))
    assert "job.yaml was changed and is left as it is: it lacks mug; there is no cup any more" in told
    assert job.read_text() == mine


WRONG = (
    (("none",), "none: there is no such folder"),
    (("file",), "file is a file"),
    (("empty",), "empty is empty"),
    (("other",), "other has no mesh"),
    (("good", "--category-from", "a/b"), "--category-from a/b: write folder, parent, file, or a name"),
    (("good", "--out", "file"), "file is there already, and no library"),
    (("good", "--out", "other"), "other is there already, and no library"),
    (("good", "--out", "file/lib"), "cannot be written"),
    (("good", "--limit", "max_fases=3"), "--limit max_fases: write NAME=VALUE: max_file_mb, max_vertices"),
    (("good", "--limit", "max_faces=x"), "--limit max_faces: write NAME=VALUE: Input should be"),
    (("good", "--licence", " "), "--licence: write some words"),
)


def test_wrong_input_is_one_clear_line_and_leaves_and_overwrites_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    write_mesh(Path("good/a.stl"), cup())
    for name, text in (("broken/a.obj", "v 0 0 0\n"), ("other/readme.txt", ""), ("file", "")):
        write(Path(name), text)
    before = {path: path.is_file() and path.read_bytes() for path in sorted(tmp_path.rglob("*"))}
    for words, says in WRONG:
        code, _, err = init(*words, capsys=capsys)
        assert code == 2 and says in err, (words, err)
        assert len(err.splitlines()) <= 3 and "Traceback" not in err
        assert before == {path: path.is_file() and path.read_bytes() for path in sorted(tmp_path.rglob("*"))}, words
    code, _, err = init("broken", capsys=capsys)
    assert code == 2 and "none of its meshes can be used: 1 left out" in err


def test_what_no_table_carries_is_asked_about_and_is_scaled_or_left_out_where_one_says_so(tmp_path, capsys):
    for name, side in (("crate", 3.0), ("barrel", 1.5), ("cup", 0.1)):
        write_mesh(tmp_path / f"m/{name}.glb", trimesh.creation.box((side, side, side)))
    for k, (words, asked, used) in enumerate((
        ((), "2 objects of 2.6 m to 5.2 m (crate.glb) are too large", {"crate": 5.196, "barrel": 2.598, "cup": 0.173}),
        (("--unit", "crate*=0.1", "--unit", "barrel*=0.5"), "1 object of 1.3 m", {"crate": 0.52, "barrel": 1.299, "cup": 0.173}),
        (("--unit", "0.1"), None, {"crate": 0.52, "barrel": 0.26, "cup": 0.017}),
        (("--limit", "max_size_m=1"), None, {"cup": 0.173}),
    )):  # fmt: skip
        code, told, _ = init(tmp_path / "m", "--out", tmp_path / f"lib{k}", "--json", *words, capsys=capsys)
        objects = json.loads(told.splitlines()[-1])["objects"]
        sizes = {one["category"]: round(float(np.linalg.norm(one["extents_m"])), 3) for one in objects}
        assert (code, sizes) == (0, used), words
        assert ("\n  ? " in told) == (asked is not None) and (asked or "") in told, told


def test_a_shape_without_picture_and_colour_is_told_of_wherever_it_is_used(tmp_path, capsys):
    colours = {"grey": (128, 128, 128, 255), "red": (200, 30, 30, 255), "white": (255, 255, 255, 255)}
    for name, colour in colours.items():
        mesh = cup()
        mesh.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=colour))
        write_mesh(tmp_path / f"m/{name}/{name}.glb", mesh)
    write_mesh(tmp_path / "m/bare/bare.stl", cup(0.2))
    write_textured(tmp_path / "m/painted/painted.obj", cup(0.15))
    code, told, _ = init(tmp_path / "m", "--out", tmp_path / "lib", "--json", capsys=capsys)
    objects = {each["path"]: each["mended"] for each in json.loads(told.splitlines()[-1])["objects"]}
    plain = sorted(path for path, notes in objects.items() if PLAIN in notes)
    assert (code, plain, len(objects)) == (0, ["bare/bare.stl", "grey/grey.glb", "white/white.glb"], 5)
    words = f"3 of 5 shapes: {PLAIN} ({', '.join(plain)})"
    assert words in told
    for folder in ("lib", "m"):  # a library, and a folder that nobody looked at
        source = {"source": "library", "folder": folder}
        job = validate_job({"name": "t", "categories": ["bare"], "assets": {"objects": [source]}}, "t")
        assert any(words in line for line in open_catalogue(job.assets, tmp_path, ("bare",)).describe_doubts())


def test_a_folder_becomes_a_studio_job_beside_that_of_the_table_with_things_of_any_size(tmp_path, capsys):
    write_mesh(tmp_path / "m/tower/tower.glb", trimesh.creation.box((3.0, 3.0, 9.0)))
    write_textured(tmp_path / "m/mug/mug.obj", cup())
    for scene, name in (("studio", "studio.yaml"), ("tabletop", "job.yaml")):
        code, told, _ = init(tmp_path / "m", "--out", tmp_path / "lib", "--scene", scene, "--json", capsys=capsys)
        assert (code, json.loads(told.splitlines()[-1])["job"]) == (0, str(tmp_path / "lib" / name))
        assert ("too large for a table. Run" in told) == (scene == "tabletop")
    job = load_job(tmp_path / "lib/studio.yaml")
    assert (job.scene, job.has_alpha, set(job.categories), job.name) == ("studio", True, {"tower", "mug"}, "m_studio")
    small = [f"cameras.sensor.{key}={value}" for key, value in SMALL_SENSOR.items()]
    pairs = [verso.make_scene(tmp_path / "lib/studio.yaml", number, small)[0] for number in range(6)]
    assert {pair.category for pair in pairs} == {"tower", "mug"}
    for pair in pairs:
        assert np.linalg.norm(pair.mesh().vertices, axis=1).max() == pytest.approx(1.0, abs=1e-6)
        covered = (pair.views("around").alpha() > 0).mean(axis=(1, 2))
        assert len(covered) == 24 and 0.1 < covered.min() <= covered.max() < 0.5


def test_a_disk_that_is_full_at_any_file_is_told_in_a_line_and_the_next_init_goes_on(tmp_path, capsys, monkeypatch):
    write_mesh(tmp_path / "m/x/cup_1.stl", cup())
    whole, out = Path.write_bytes, tmp_path / "lib"
    for name in ("library.parquet", r"x-cup_1-\w+.glb", "sheet.jpg", "job.yaml"):

        def write_or_fail(path, data, name=name):
            if re.fullmatch(rf"\.{name}\.\d+", path.name):
                raise OSError(28, "No space left on device")
            return whole(path, data)

        with monkeypatch.context() as patch:
            patch.setattr(Path, "write_bytes", write_or_fail)
            code, _, err = init(tmp_path / "m", "--out", out, capsys=capsys)
        assert code == 2 and re.search(rf"{name} cannot be written: No space left on device", err), (name, err)
        assert "Traceback" not in err
    assert init(tmp_path / "m", "--out", out, capsys=capsys)[0] == 0
    (row,) = read_table(out).rows
    assert row.parts > 3, "a cup is hollow"
    assert not [path.name for path in out.rglob(".*") if path.name != ".lock"], "no part of a file stays"


def test_without_opengl_there_is_a_library_and_no_picture(tmp_path, capsys, monkeypatch):
    def no_gl():
        raise MachineError("no OpenGL here: install libegl1")

    monkeypatch.setattr(command, "shared_renderer", no_gl)
    write_mesh(tmp_path / "m/x/cup_1.stl", cup())
    code, _, err = init(tmp_path / "m", "--category-from", "thing", "--out", tmp_path / "a", capsys=capsys)
    assert code == 0 and err == "verso: no pictures: no OpenGL here: install libegl1\n"
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == [".lock", "job.yaml", "library.parquet", "shapes"]
    assert set(load_job(tmp_path / "a/job.yaml").categories) == {"thing"}


@pytest.mark.minute
@pytest.mark.shared_data
def test_scanned_meshes_offer_their_urdfs_and_a_bottle_that_lies_is_stood_up(tmp_path, capsys):
    code, told, _ = init(ROOT.parent / "shared/data/meshes", "--out", tmp_path / "lib", "--json", capsys=capsys)
    objects = {one["category"]: one for one in json.loads(told.splitlines()[-1])["objects"]}
    assert code == 0 and set(objects) == {"blue_cup", "bowl", "cracker_box", "mug", "shampoo"}
    assert {name: one["up"] for name, one in objects.items()} == dict.fromkeys(objects, "z") | {"shampoo": "y"}
    assert objects["shampoo"]["extents_m"][2] == pytest.approx(0.1686, abs=1e-3)
    assert "20000" in told and "0 of 1" in told
    assert "plain base colour used" in str(objects["mug"]["mended"]) and objects["blue_cup"]["pictures"] == 1


CASES = {
    "palette_twins": lambda rows: len(rows) == 2 and {row["pictures"] for row in rows} == {1},
    "sdf_two_versions": lambda rows: [row["path"] for row in rows] == ["model.sdf"],
    "sdf_ogre_script": lambda rows: rows[0]["pictures"] == 1,
    "unit_of_second_group": lambda rows: (
        {row["path"]: row["unit"] for row in rows if row["path"] > "b"}
        == {"b0.obj": 0.001, "b1.obj": 0.001, "bunny.obj": 1.0}
    ),
    "dae_latin1": lambda rows: rows[0]["extents_m"] == pytest.approx([0.1, 0.16, 0.24]),
    "obj_mtl_bom": lambda rows: [row["pictures"] for row in rows] == [1, 1],
}
"""What is right of folders in `../shared/data/mesh_cases`."""


@pytest.mark.minute
@pytest.mark.shared_data
@pytest.mark.parametrize("name", CASES)
def test_folders_that_were_read_wrong_are_read_right(tmp_path, capsys, name):
    folder = ROOT.parent / "shared/data/mesh_cases" / name
    code, told, _ = init(folder, "--out", tmp_path / "lib", "--json", capsys=capsys)
    assert code == 0 and CASES[name](json.loads(told.splitlines()[-1])["objects"]), told


# ------------------------------------------------------------------------------------------------ what is found and shown


def test_meshes_are_found_at_any_depth_and_what_cannot_be_used_is_named(tmp_path, monkeypatch):
    names = "b.obj", "a/b/c.GLB", "a/x.urdf", ".h/a.obj", "a/.b.obj", "__MACOSX/a.obj", "a/skin.png", "bad\nname.obj"
    for name in (*names, "../out.obj", os.fsdecode(b"bad\xff.obj"), "locked.obj"):
        write(tmp_path / "in" / name, "")
    for link, target in (("link.obj", "../out.obj"), ("dead.obj", "none.obj"), ("inner.obj", "b.obj")):
        (tmp_path / "in" / link).symlink_to(target)
    # The system is asked through `os`, because root may read everything.
    monkeypatch.setattr(collection.os, "access", lambda path, how: "locked" not in str(path))
    write(tmp_path / "in/a/robot.xml", "<!-- x --><mujoco/>")
    for name, text in (
        ("package.xml", "<package/>"),
        ("a/r.urdf.xacro", ""),
        ("a/all.tar.gz", ""),
        ("a/scan.FBX", ""),
        ("a/b.vrm", ""),
    ):
        write(tmp_path / "in" / name, text)
    paths, left_out = walk_folder(tmp_path / "in")
    told = {one.path: one.why for one in left_out if one.reason == "format"}
    assert (
        set(told) == {"a/r.urdf.xacro", "a/all.tar.gz", "a/scan.FBX", "a/b.vrm"}
        and "`xacro FILE" in told["a/r.urdf.xacro"]
    )
    left_out = [one for one in left_out if one.path not in told]
    assert paths == ["a/b/c.GLB", "a/robot.xml", "a/x.urdf", "b.obj"]
    reasons = {"bad\\nname.obj": "name", "bad\\udcff.obj": "name", "dead.obj": "missing", "link.obj": "link"}
    assert {one.path: one.reason for one in left_out} == {**reasons, "locked.obj": "permission"}
    with pytest.raises(AssetSourceError, match=r"bad\\nname: there is no such folder"):
        walk_folder(tmp_path / "bad\nname")

    def deny(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(collection.Path, "iterdir", deny)
    with pytest.raises(AssetSourceError, match="cannot be listed: Permission denied"):
        walk_folder(tmp_path / "in")


def test_of_packages_each_object_is_offered_once_by_what_they_say_of_themselves(tmp_path):
    root = tmp_path / "in"
    for version, name in (("1.10", "model.sdf"), ("1.9", "model-1_9.sdf"), ("1.11", "gone.sdf")):
        write(root / "sign" / name, "<sdf/>") if name != "gone.sdf" else None
        config = root / "sign/model.config"
        config.write_text((config.read_text() if config.exists() else "") + f"<sdf version='{version}'>{name}</sdf>\n")
    write(root / "old/model.sdf", "<sdf/>")  # without a word of versions, as it was
    write(root / "old/model-1_2.sdf", "<sdf/>")
    write(root / "bop/models/obj_000001.ply", "")
    write(root / "bop/models_eval/obj_000001.ply", "")
    write(root / ".annex/77a9", "")
    (root / "linked").mkdir()
    (root / "linked/cup.obj").symlink_to(root / ".annex/77a9")
    (root / "linked/cup2.obj").symlink_to(root / ".annex/77a9")
    (root / "away").symlink_to(tmp_path / "out", target_is_directory=True)
    (root / "again").symlink_to(root / "bop", target_is_directory=True)
    (tmp_path / "out").mkdir()
    paths, left_out = walk_folder(root)
    told = {one.path: one.why for one in left_out}
    assert paths == [
        *("bop/models/obj_000001.ply", "bop/models_eval/obj_000001.ply", "linked/cup.obj"),
        *("old/model-1_2.sdf", "old/model.sdf", "sign/model.sdf"),
    ]
    assert told.pop("sign/model-1_9.sdf") == "other version of model.sdf, by model.config"
    assert "cp -rL" in told.pop("away") and not told
    assert find_copies(paths, paths) == {paths[1]: f"made for evaluation, of {paths[0]}"}


def test_bops_table_of_models_gives_their_unit(tmp_path):
    info = {"1": {"diameter": 150.0, "size_x": 30.0, "size_y": 40.0, "size_z": 120.0}, "2": {"size_x": "?"}}
    write(tmp_path / "models_info.json", json.dumps(info))
    for name, diagonal, unit in (
        *(("obj_000001.ply", 130.0, 0.001), ("obj_000001.ply", 0.1302, 1.0), ("obj_000001.ply", 99.0, None)),
        *(("obj_000002.ply", 130.0, None), ("obj_000003.ply", 130.0, None), ("mug.ply", 130.0, None)),
    ):
        assert find_unit(tmp_path / name, diagonal) == unit, name
    mesh = write_mesh(tmp_path / "obj_000001.ply", cup())
    assert list_files(tmp_path, mesh, MeshLimits()) == (mesh, tmp_path / "models_info.json"), (
        "so that a change is noticed"
    )


ROW = (
    *("a_folder/of_a_long_name/and_a_mesh.obj", "category", "12.3 x 4.5 x 67.8", "20000", "yes", "1", "y sure"),
    "note " * 30 + "word" * 40,
)


def left_row(path, reason, why):
    return Row(path, use=False, reason=reason, why=why)


def test_tables_fit_the_terminal_and_no_name_or_reason_is_ever_cut():
    def letters(text):
        return re.sub(r"\s", "", text)

    for width in (60, 80, 100, 140, None):
        lines = draw_table([ROW], width)
        assert all(len(line) <= (width or 1000) for line in lines) and (len(lines) == 2) == (width is None)
        assert sorted(letters("".join(lines))) == sorted(letters("".join((*HEADINGS, *ROW)))), "nothing is left out"
        left = draw_left_out([left_row(ROW[0], "size", ROW[-1].strip())], width)
        assert all(len(line) <= (width or 1000) for line in left)
        assert letters("".join(left)) == letters(f"left out: 1 file{ROW[0]}(size):{ROW[-1]}")
    assert draw_table([ROW] * (MOST_ROWS + 5), 100)[-1] == "and 5 more: --json lists all"
    assert len(draw_table([ROW] * (MOST_ROWS + 5), None)) == MOST_ROWS + 6, "a pipe has all"
    left = [left_row(f"{k}.obj", "missing", f"why {k}") for k in range(MOST_ROWS + 3)]
    lines = draw_left_out(left, 100)
    assert lines[0] == f"left out: {MOST_ROWS + 3} files" and lines[1] == "  0.obj (missing): why 0"
    assert lines[-1] == "  and 3 more: --json lists all" and len(draw_left_out(left, None)) == MOST_ROWS + 4
    alike = [left_row(f"{k}.fbx", "format", ".fbx is not read") for k in range(40)]
    assert draw_left_out(alike, 100)[1:] == ["  0.fbx and 39 more (format): .fbx is not read"], "a line each kind"
    assert draw_left_out([], 100) == []
    words = ("object", "1 object 2 objects"), ("mesh", "1 mesh 2 meshes"), ("category", "1 category 2 categories")
    assert all(f"{plural(1, word)} {plural(2, word)}" == told for word, told in words)


def bottle(scale=1.0, turned=False):
    made = make_asset("bottle", ProceduralSource(source="procedural"), 0, 600.0)
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if turned else np.eye(3)
    return replace(made, shape=transform_shape(made.shape, pose(scale * turn, np.zeros(3))))


def test_an_object_of_any_size_fills_its_picture_and_stands_in_it_or_is_seen_to_lie():
    pictures = {}
    for scale, turned in ((0.001, False), (1.0, False), (50.0, False), (1.0, True)):
        picture = pictures[scale, turned] = np.asarray(draw_object(bottle(scale, turned), shared_renderer()), float)
        assert picture.shape[1::-1] == TILE
        rows, columns = np.nonzero(np.abs(picture - picture[5, 5]).max(axis=2) > 45)
        assert rows.min() > 2 and rows.max() < TILE[1] - 2, "nothing is cut off"
        assert abs(np.median(columns) - TILE[0] / 2) < 0.2 * TILE[0]
        assert turned or np.ptp(rows) > 0.5 * TILE[1]
    assert (np.abs(pictures[1.0, False] - pictures[1.0, True]).max(axis=2) > 40).mean() > 0.05


def test_a_unit_that_is_not_that_of_the_format_is_noted_where_the_file_is_shown():
    for path, unit, noted in (
        ("a/m.sdf", 0.01, True),
        ("M.GLB", 0.001, True),
        ("m.glb", 1.0, False),
        ("m.stl", 0.01, False),
    ):
        row = Row(path, unit=unit, extents_m=(0.1, 0.1, 0.1), mended=("so",))
        told = f"a unit is taken for {'1 cm' if unit == 0.01 else '1 mm'}, where the format says 1 m: see `unit`"
        assert notes_of(row) == (*[told] * noted, "so")


def test_as_many_as_fit_are_drawn_and_the_rest_is_counted(monkeypatch):
    monkeypatch.setattr(shown, "MOST", 2)
    loaded = []
    one = Row("näme", category="mug", extents_m=(1, 1, 1), faces=12, watertight=True, pictures=0, mended=("a " * 99,))
    tiles = [(one, lambda: loaded.append(1) or bottle())] * 5
    assert cells_of(one)[:3] == ("näme", "mug", "100 x 100 x 100")
    page, two = (draw_sheet("title", some, ["left out: x"], shared_renderer()) for some in (tiles, tiles[:2]))
    assert len(loaded) == 4 and page.height > two.height, "a line says how many are not drawn"
    assert page.width >= 2 * TILE[0] and (np.asarray(page) < 128).any()


# ------------------------------------------------------------------------------------------------ its page

PAGE = (ROOT / "docs" / "own_meshes.md").read_text()
LINES = [line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()]
COMMANDS = [shlex.split(line)[1:] for line in LINES]


def test_every_format_that_is_read_has_its_line():
    rows = "".join(line.partition(":")[0] for line in PAGE.splitlines() if line.startswith("- `."))
    assert set(re.findall(r"`(\.\w+)`", rows)) == set(SUFFIXES)


@pytest.mark.ray
@pytest.mark.minute
def test_its_commands_run_as_printed_and_make_a_dataset_in_which_everything_stands(tmp_path, capsys, monkeypatch):
    mixed_folder(tmp_path / "meshes")
    monkeypatch.chdir(tmp_path)
    assert len(COMMANDS) == 5
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for words in COMMANDS:
        if words[0] == "init" or "--dry-run" in words:
            assert main(words) == 0, words
    assert "categories: 002_can 1, bottles 1" in capsys.readouterr().out
    edit = PAGE.split("```python\n")[1].split("```")[0]
    subprocess.run([sys.executable, "-c", edit], check=True)
    assert main(COMMANDS[0]) == 0
    assert {row.up for row in read_table(tmp_path / "meshes_library").rows if row.path == "standing.glb"} == {"z"}
    whole = [sys.executable, "-m", "services.cli.main", *COMMANDS[2]]
    subprocess.run(whole, env=environment, check=True, capture_output=True)
    tables = [
        ds.dataset(tmp_path / f"data/meshes/manifest/{name}", partitioning="hive") for name in ("scenes", "assets")
    ]
    scenes, assets = (table.to_table().to_pylist() for table in tables)
    assert len(scenes) == 8 and len({row["category"] for row in scenes}) > 2
    views = ds.dataset(tmp_path / "data/meshes/manifest/views", partitioning="hive").to_table().to_pylist()
    shares = [row["object_pixels"] / (640 * 480) for row in views if row["role"] == "input"]
    assert len(shares) == 8 and min(shares) > 0.03 and max(shares) < 0.1, "objects of any size are framed"
    heights = {row["path"]: row["extents_m"][2] for row in assets if row["source"] == "library"}
    true = {"mugs/mug_0.glb": 0.08, "mugs/mug_1.glb": 0.1, "mugs/mug_2.glb": 0.12, "gltf cup/model.gltf": 0.1}
    drawn = {path: height for path, height in heights.items() if path in true}
    assert drawn == pytest.approx({path: true[path] for path in drawn}, abs=1e-6)
