"""Sources of files: folders with a map, pybullet_data, and ShapeNetCore in two layouts made up here."""

import numpy as np
import pyarrow as pa
import pytest
from workers.assets.external.listing import find_files, find_licence, list_licences, locate_folder
from workers.assets.external.placement import load_entry
from workers.assets.external.verdicts import Verdicts, check_listing

from schemas.dataset.tables import SCHEMAS
from schemas.errors import AssetSourceError
from schemas.job.assets import BUILT_IN, Assets, FolderSource, MeshLimits, ShapeNetSource
from schemas.job.job import Job
from tests.workers.door.oracles import (
    CUBE,
    gltf,
    picture,
    textured_cube,
    textured_obj,
    urdf,
    visual,
    write,
    write_all,
)
from workers.assets.catalogue import list_source
from workers.scene.rows import asset_row

LIMITS, ASSETS = MeshLimits(), Assets(density_kg_m3=600.0, shell_kg_m2=3.0)
TALL = CUBE.replace("v 0 1", "v 0 3").replace("v 1 1", "v 1 3")  # 1 x 3 x 1: +Y is up


def source(**more):
    return FolderSource(source="urdf", folder=".", **more)


def net(**more):
    return ShapeNetSource(source="shapenet", folder=".", **more)


def listed(settings, folder, *categories, **limits):
    """What a source offers: its listing, and the files of each entry by category."""
    listing = list_source(settings, folder, set(categories or ("mug",)), MeshLimits(**limits))
    return listing, {c: [[file.path for file in e.files] for e in found] for c, found in listing.entries.items()}


def loaded(settings, folder, category="mug", number=0):
    """An asset of a source."""
    listing = list_source(settings, folder, {category}, LIMITS)
    return load_entry(settings, listing.folder, listing.entries[category][number], category, ASSETS)


def test_the_first_pattern_that_fits_gives_the_category_and_links_out_of_the_folder_are_not_followed(tmp_path):
    for name in ("mugs/a.obj", "mugs/box_b.obj", "other/c.obj", "deep/er/d.obj"):
        write(tmp_path / "in" / name, CUBE)
    write(tmp_path / "out.obj", CUBE)
    (tmp_path / "in/mugs/link.obj").symlink_to(tmp_path / "out.obj")
    settings = source(category_map={"**": "box", "mugs/box_*.obj": "box", "mugs/*.obj": "mug", "deep/**/*.obj": "can"})
    _, found = listed(settings, tmp_path / "in", "mug", "box", "can")
    assert found == {"mug": [["mugs/a.obj"]], "box": [["mugs/box_b.obj"]], "can": [["deep/er/d.obj"]]}


def test_files_are_turned_scaled_and_sized_as_the_source_says(tmp_path):
    write(tmp_path / "a.obj", TALL)
    one = source(category_map={"*.obj": "mug"}, up="y", scale=0.1)
    assert loaded(one, tmp_path).extents_m == pytest.approx([0.1, 0.1, 0.3])
    sized = one.model_copy(update={"diagonal_m": 0.25})
    assert float(np.linalg.norm(loaded(sized, tmp_path).extents_m)) == pytest.approx(0.25)


def test_ids_are_safe_as_file_names_and_differ_with_path_bytes_and_settings(tmp_path):
    write(tmp_path / "a b/c d.obj", CUBE)
    write(tmp_path / "a-b/c-d.obj", CUBE)
    ids = []
    for more in ({}, {"scale": 2.0}):
        listing, _ = listed(source(category_map={"**/*.obj": "mug"}, **more), tmp_path)
        ids += [entry.instance_id for entry in listing.entries["mug"]]
    assert len(set(ids)) == 4 and all(set(name) <= set("abcdef0123456789-") for name in ids)


def test_an_entry_has_all_that_it_needs_and_broken_ones_are_counted(tmp_path):
    write_all(tmp_path, textured_obj())
    write_all(tmp_path, gltf())
    write(tmp_path / "skin.png", picture())
    write(tmp_path / "a.urdf", urdf(visual('<mesh filename="cube.obj"/>')))
    write(tmp_path / "b.urdf", urdf(visual('<mesh filename="none.obj"/>')))
    write(tmp_path / "c.urdf", "<robot")
    write(tmp_path / "d.fbx", "")
    listing, found = listed(source(category_map={"*.urdf": "mug", "*.fbx": "mug", "*.gltf": "mug"}), tmp_path)
    files = ["a.urdf", "cube.obj", "cube.mtl", "skin.png"], ["cube.gltf", "cube.bin", "skin.png"]
    assert found == {"mug": list(files)}
    assert listing.skipped == {"format": 1, "missing": 1, "unreadable": 1}


OTHER = {
    "pointer.obj": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "missing", "git lfs pull"),
    "pointer.urdf": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "missing", "git lfs pull"),
    "page.stl": (b"\n<!DOCTYPE html><html>404", "format", "is a web page"),
    "page.obj": (b"<html><body>v 0 0 0", "format", "is a web page"),
    "empty.glb": (b"", "no_faces", "is empty"),
    "old.glb": (b"glTF\x01\0\0\0\x20\0\0\0", "format", "glTF of version 1"),
    "packed.ply": (b"PK\x03\x04 and more", "format", "is an archive"),
    "cloud.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n",
        "no_faces",
        "a point cloud",
    ),
    "splat.ply": (b"ply\nelement vertex 1\nproperty float f_dc_0\nend_header\n", "no_faces", "Gaussian splats"),
    "paper.obj": (b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n", "no_size", "is flat, without thickness"),
    "tilted.obj": (b"v 0 0 0\nv 1 0 1\nv 1 1 2\nv 0 1 1\nf 1 2 3 4\n", "no_size", "is flat, without thickness"),
}


def test_what_a_file_really_is_is_told_with_what_to_do(tmp_path):
    write_all(tmp_path, {"cube.obj": CUBE.encode(), **{name: data for name, (data, _, _) in OTHER.items()}})
    settings = source(category_map={"*": "mug"})
    listing = check_listing(settings, list_source(settings, tmp_path, {"mug"}, LIMITS), ASSETS, Verdicts(None))
    for name, (_, reason, says) in OTHER.items():
        settings = source(category_map={name: "mug"})
        one = check_listing(settings, list_source(settings, tmp_path, {"mug"}, LIMITS), ASSETS, Verdicts(None))
        assert one.skipped == {reason: 1} and says in one.examples[0], name
    assert listing.count("mug") == 1, "the cube is read"


def test_what_cannot_be_used_of_a_source_is_refused_with_the_remedy(tmp_path):
    for name in "gfedcba":
        write(tmp_path / f"{name}.obj", CUBE)
    write(tmp_path / "empty/.keep", "")
    some = {"*.obj": "mug"}
    for settings, folder, says in (
        (source(), tmp_path, r"needs a `category_map`.*It has a\.obj, b\.obj, c\.obj, d\.obj, e\.obj and 3 more"),
        (source(category_map={"/abs/*.obj": "mug"}), tmp_path, "not a pattern below the folder"),
        (source(category_map=some), tmp_path / "none", "is not a folder"),
        (source(category_map=some, up={"*.obj": "y", "b/*": "x"}), tmp_path, r"up: 'b/\*' finds none of the 7 files"),
        (source(category_map=some, up="y").model_copy(update={"folder": "~nobody7/x"}), tmp_path, "no such user"),
        (net(), tmp_path / "none", "is not a folder"),
        (net(), tmp_path, r"none of the synset folders 03797390 \(mug\).*a\.obj"),
    ):
        with pytest.raises(AssetSourceError, match=says):
            list_source(settings, folder, {"mug"}, LIMITS)
    assert find_files(source(category_map=some, up={"*.obj": "y"}), tmp_path, ("mug",))[0] == tmp_path


def test_the_nearest_licence_file_is_named_unless_the_user_states_one(tmp_path):
    for path in ("LICENSE", "mug/licence.txt", "mug/a/mug.obj", "bowl/bowl.obj"):
        write(tmp_path / path, "x")
    files = list_licences(tmp_path)
    for path, stated, known, licence in (
        ("mug/a/mug.obj", "unknown", files, "see mug/licence.txt"),
        ("bowl/bowl.obj", "unknown", files, "see LICENSE"),
        ("bowl/bowl.obj", "MIT", files, "MIT"),
        ("bowl/bowl.obj", "unknown", [], "unknown"),
    ):
        assert find_licence(tmp_path / path, tmp_path, stated, known) == licence


def test_what_was_left_out_of_a_mesh_is_told_by_its_row_in_the_assets_table(tmp_path):
    textured_cube(tmp_path)
    write(tmp_path / "skin.png", b"\x89PNG\r\n\x1a\n and no more")
    write(tmp_path / "thing.urdf", urdf(visual('<mesh filename="cube.obj"/>')))
    for name in ("cube.obj", "thing.urdf"):
        row = asset_row(loaded(source(category_map={name: "mug"}), tmp_path), Job(name="t"))
        (note,) = pa.Table.from_pylist([row], schema=SCHEMAS["assets"])["notes"][0].as_py()
        assert note.startswith("skin.png is no picture") and note.endswith("plain base colour used")
        assert " at 0x" not in note, "an address is another in every run"


def test_folders_are_relative_to_the_job_file_and_pybullet_data_is_the_package_with_a_map_of_its_own(tmp_path):
    assert locate_folder("things", tmp_path) == tmp_path / "things"
    settings = FolderSource(source="urdf", folder="pybullet_data")
    listing, found = listed(settings, tmp_path, "mug", "table")
    assert [files[0] for files in found["mug"]] == ["objects/mug.urdf"]
    assert {entry.licence for entries in listing.entries.values() for entry in entries} == {"unknown"}
    tables = [loaded(settings, tmp_path, "table", number) for number in (0, 1)]
    # table.urdf: a top of 1.5 x 1 x 0.05 m whose middle is at 0.6 m, on legs that reach down to 0.
    assert tables[0].extents_m == pytest.approx([1.5, 1.0, 0.625]) and tables[0].watertight
    assert tables[1].extents_m == pytest.approx([0.6, 0.6, 0.64]) and tables[1].watertight
    mug = loaded(settings, tmp_path)
    assert mug.extents_m[2] == pytest.approx(0.1, abs=1e-3)
    assert mug.shape.parts[0].material.base_color == (1.0, 0.2, 0.2, 1.0)


# ------------------------------------------------------------------------------------------------ ShapeNetCore


def version_2(root, category, model, text=TALL):
    return write(root / str(BUILT_IN[category].synset) / model / "models" / "model_normalized.obj", text)


def version_1(root, category, model, text=TALL):
    return write(root / str(BUILT_IN[category].synset) / model / "model.obj", text)


@pytest.mark.parametrize("layout", [version_1, version_2])
def test_both_layouts_are_read_and_y_becomes_z(tmp_path, layout):
    layout(tmp_path, "mug", "abc")
    asset = loaded(net(), tmp_path)
    assert asset.extents_m == pytest.approx([0.25, 0.25, 0.75])
    assert (asset.instance_id, asset.watertight, asset.shareable) == ("03797390-abc", True, False)
    # A point at the front of the model, -Z, has +y here; one above has +z.
    front, above = (asset.T_source_to_object[:3, :3] @ axis for axis in (np.array([0, 0, -1]), np.array([0, 1, 0])))
    assert front == pytest.approx([0, 1, 0]) and above == pytest.approx([0, 0, 1])
    layout(tmp_path, "table", "t")
    assert loaded(net(), tmp_path, "table").scale == 1.5, "tables have their own scale"
    assert loaded(net(scale=2.0), tmp_path, "table").scale == 2.0, "and a setting replaces both"


def test_models_without_a_usable_mesh_are_skipped_and_textures_lie_beside_the_models_folder(tmp_path):
    mesh = version_2(tmp_path, "mug", "good", "mtllib model_normalized.mtl\n" + TALL)
    write(mesh.with_suffix(".mtl"), "newmtl a\nmap_Kd ../images/texture0.jpg\n")
    write(mesh.parent.parent / "images" / "texture0.jpg", b"jpg")
    version_2(tmp_path, "mug", "large", TALL * 3)
    (tmp_path / str(BUILT_IN["mug"].synset) / "empty").mkdir()
    listing, found = listed(net(), tmp_path, max_faces=17)
    assert [entry.instance_id for entry in listing.entries["mug"]] == ["03797390-good"]
    assert found["mug"][0][2].endswith("good/images/texture0.jpg")
    assert listing.skipped == {"missing": 1, "too_large": 1}
    assert listed(net(), tmp_path, "box")[1] == {}, "ShapeNet has no box"
