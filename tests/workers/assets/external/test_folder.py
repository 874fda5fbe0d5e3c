"""Folders of URDFs and meshes with a category map, and the meshes inside the pybullet_data package."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from schemas.dataset.tables import SCHEMAS
from schemas.errors import AssetSourceError
from schemas.job.assets import Assets, FolderSource, MeshLimits
from schemas.job.job import Job
from tests.workers.assets.oracles import CUBE, textured_cube, write
from workers.assets.catalogue import list_source
from workers.assets.external.listing import find_files, locate_folder
from workers.assets.external.placement import load_entry
from workers.scene.rows import asset_row

LIMITS, ASSETS = MeshLimits(), Assets(density_kg_m3=600.0, shell_kg_m2=3.0)
SHARED = Path(__file__).resolve().parents[5] / "shared" / "data" / "meshes"


def source(**more):
    return FolderSource(source="urdf", folder=".", **more)


def test_the_first_pattern_that_fits_gives_the_category(tmp_path):
    for name in ("mugs/a.obj", "mugs/box_b.obj", "other/c.obj", "deep/er/d.obj"):
        write(tmp_path / name, CUBE)
    settings = source(category_map={"mugs/box_*.obj": "box", "mugs/*.obj": "mug", "deep/**/*.obj": "can"})
    listing = list_source(settings, tmp_path, {"mug", "box", "can"}, LIMITS)
    found = {category: [entry.files[0].path for entry in entries] for category, entries in listing.entries.items()}
    assert found == {"mug": ["mugs/a.obj"], "box": ["mugs/box_b.obj"], "can": ["deep/er/d.obj"]}


def test_files_are_turned_scaled_and_sized_as_the_source_says(tmp_path):
    write(tmp_path / "a.obj", CUBE.replace("v 0 1", "v 0 3").replace("v 1 1", "v 1 3"))
    settings = source(category_map={"*.obj": "mug"}, up="y", scale=0.1)
    listing = list_source(settings, tmp_path, {"mug"}, LIMITS)
    asset = load_entry(settings, listing.folder, listing.entries["mug"][0], "mug", ASSETS)
    assert asset.extents_m == pytest.approx([0.1, 0.1, 0.3])
    settings = source(category_map={"*.obj": "mug"}, up="y", diagonal_m=0.25)
    asset = load_entry(settings, listing.folder, listing.entries["mug"][0], "mug", ASSETS)
    assert float(np.linalg.norm(asset.extents_m)) == pytest.approx(0.25)


def test_ids_are_safe_as_file_names_and_differ_with_path_bytes_and_settings(tmp_path):
    write(tmp_path / "a b/c d.obj", CUBE)
    write(tmp_path / "a-b/c-d.obj", CUBE)
    ids = []
    for more in ({}, {"scale": 2.0}):
        settings = source(category_map={"**/*.obj": "mug"}, **more)
        ids += [entry.instance_id for entry in list_source(settings, tmp_path, {"mug"}, LIMITS).entries["mug"]]
    assert len(set(ids)) == 4
    assert all(set(name) <= set("abcdef0123456789-") for name in ids)


def test_meshes_that_a_urdf_needs_are_part_of_its_entry_and_broken_ones_are_counted(tmp_path):
    write(tmp_path / "cube.obj", CUBE)
    mesh = '<robot name="r"><link name="l"><visual><geometry><mesh filename="{}"/></geometry></visual></link></robot>'
    write(tmp_path / "a.urdf", mesh.format("cube.obj"))
    write(tmp_path / "b.urdf", mesh.format("none.obj"))
    write(tmp_path / "c.urdf", "<robot")
    write(tmp_path / "d.dae", "")
    listing = list_source(source(category_map={"*.urdf": "mug", "*.dae": "mug"}), tmp_path, {"mug"}, LIMITS)
    assert [[file.path for file in entry.files] for entry in listing.entries["mug"]] == [["a.urdf", "cube.obj"]]
    assert listing.skipped == {"format": 1, "missing": 1, "unreadable": 1}


def test_a_link_out_of_the_folder_is_not_followed(tmp_path):
    write(tmp_path / "out/a.obj", CUBE)
    (tmp_path / "in").mkdir()
    (tmp_path / "in/a.obj").symlink_to(tmp_path / "out/a.obj")
    assert list_source(source(category_map={"*.obj": "mug"}), tmp_path / "in", {"mug"}, LIMITS).entries["mug"] == ()


def test_a_category_has_any_name(tmp_path):
    write(tmp_path / "a.obj", CUBE)
    listing = list_source(source(category_map={"*.obj": "banana"}), tmp_path, {"banana"}, LIMITS)
    assert [entry.files[0].path for entry in listing.entries["banana"]] == ["a.obj"]


def test_a_map_that_cannot_be_used_is_refused_with_the_remedy(tmp_path):
    write(tmp_path / "a.obj", CUBE)
    with pytest.raises(AssetSourceError, match=r"needs a `category_map`.*It has a\.obj"):
        list_source(source(), tmp_path, {"mug"}, LIMITS)
    with pytest.raises(AssetSourceError, match="not a pattern below the folder"):
        list_source(source(category_map={"/abs/*.obj": "mug"}), tmp_path, {"mug"}, LIMITS)
    with pytest.raises(AssetSourceError, match="is not a folder"):
        list_source(source(category_map={"*.obj": "mug"}), tmp_path / "none", {"mug"}, LIMITS)


def test_folders_are_relative_to_the_job_file_and_pybullet_data_is_the_package(tmp_path):
    assert locate_folder("things", tmp_path) == tmp_path / "things"
    assert (locate_folder("pybullet_data", tmp_path) / "table" / "table.urdf").is_file()


def test_the_meshes_inside_pybullet_data_have_a_map_of_their_own(tmp_path):
    settings = FolderSource(source="urdf", folder="pybullet_data")
    listing = list_source(settings, tmp_path, {"mug", "table"}, LIMITS)
    assert [entry.files[0].path for entry in listing.entries["mug"]] == ["objects/mug.urdf"]
    assert {entry.licence for entries in listing.entries.values() for entry in entries} == {"unknown"}
    tables = [load_entry(settings, listing.folder, e, "table", ASSETS) for e in listing.entries["table"]]
    # table.urdf: a top of 1.5 x 1 x 0.05 m whose middle is at 0.6 m, on legs that reach down to 0.
    assert tables[0].extents_m == pytest.approx([1.5, 1.0, 0.625])
    assert tables[1].extents_m == pytest.approx([0.6, 0.6, 0.64])
    assert all(table.watertight for table in tables)
    mug = load_entry(settings, listing.folder, listing.entries["mug"][0], "mug", ASSETS)
    assert mug.extents_m[2] == pytest.approx(0.1, abs=1e-3)
    assert mug.shape.parts[0].material.base_color == (1.0, 0.2, 0.2, 1.0)


@pytest.mark.shared_data
def test_scanned_things_load_through_their_urdfs():
    settings = FolderSource(source="urdf", folder=".", category_map={"*/model.urdf": "mug"})
    listing = list_source(settings, SHARED, {"mug"}, LIMITS)
    assert len(listing.entries["mug"]) == 5
    for entry in listing.entries["mug"]:
        asset = load_entry(settings, listing.folder, entry, "mug", ASSETS)
        assert asset.watertight
        assert asset.volume_m3 is not None
        assert 2e-5 < asset.volume_m3 < 3e-3
        assert entry.licence == "see LICENSE"


URDF = '<robot name="r"><link name="l"><visual><geometry><mesh filename="cube.obj"/></geometry></visual></link></robot>'


@pytest.mark.parametrize("name", ["cube.obj", "thing.urdf"])
def test_what_was_left_out_of_a_mesh_is_told_by_its_row_in_the_assets_table(tmp_path, name):
    textured_cube(tmp_path)
    write(tmp_path / "skin.png", b"\x89PNG\r\n\x1a\n and no more")
    write(tmp_path / "thing.urdf", URDF)
    settings = source(category_map={name: "mug"})
    listing = list_source(settings, tmp_path, {"mug"}, LIMITS)
    asset = load_entry(settings, listing.folder, listing.entries["mug"][0], "mug", ASSETS)
    row = asset_row(asset, Job(name="t"))
    table = pa.Table.from_pylist([row], schema=SCHEMAS["assets"])
    (note,) = table["notes"][0].as_py()
    assert note.startswith("skin.png cannot be opened") and note.endswith("plain base colour used")
    assert " at 0x" not in note, "an address is another in every run"


def test_a_pattern_of_up_that_finds_nothing_is_most_likely_misspelt(tmp_path):
    write(tmp_path / "a.glb", b"")
    source = FolderSource(source="urdf", folder=str(tmp_path), category_map={"*": "mug"}, up={"*.glb": "y", "b/*": "x"})
    with pytest.raises(AssetSourceError, match=r"up: 'b/\*' finds none of the 1 files"):
        find_files(source, tmp_path, ("mug",))
