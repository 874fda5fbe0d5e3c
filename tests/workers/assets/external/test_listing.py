"""Files of a source: folders with a map, pybullet_data, and ShapeNetCore in two layouts made up here."""

import pickle
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from schemas.dataset.tables import SCHEMAS
from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import BUILT_IN, Assets, FolderSource, MeshLimits, ShapeNetSource
from schemas.job.job import Job
from tests.workers.assets.oracles import CUBE, textured_cube, write
from workers.assets.catalogue import list_source
from workers.assets.external.listing import (
    Entry,
    check_unchanged,
    describe_folder,
    find_files,
    find_licence,
    hash_files,
    list_licences,
    locate_folder,
)
from workers.assets.external.placement import load_entry
from workers.scene.rows import asset_row


def test_a_file_that_changed_since_is_noticed(tmp_path):
    path = write(tmp_path / "cube.obj", CUBE)
    entry = Entry("id", hash_files([path], tmp_path), "MIT")
    check_unchanged(tmp_path, entry)
    write(path, CUBE + "# more\n")
    with pytest.raises(MeshError, match="changed") as changed:
        check_unchanged(tmp_path, entry)
    path.unlink()
    with pytest.raises(MeshError, match="missing") as missing:
        check_unchanged(tmp_path, entry)
    # Neither is a function of job and seed, and it stays so on the way to another process.
    assert {pickle.loads(pickle.dumps(error.value)).kind for error in (changed, missing)} == {"environmental"}


def test_a_message_names_the_first_things_of_a_folder(tmp_path):
    assert describe_folder(tmp_path) == "nothing"
    for name in "gfedcba":
        write(tmp_path / name, "")
    assert describe_folder(tmp_path) == "a, b, c, d, e and 2 more"


def test_the_nearest_licence_file_is_named_unless_the_user_states_one(tmp_path):
    for path in ("LICENSE", "mug/licence.txt", "mug/a/mug.obj", "bowl/bowl.obj"):
        write(tmp_path / path, "x")
    files = list_licences(tmp_path)
    assert find_licence(tmp_path / "mug/a/mug.obj", tmp_path, "unknown", files) == "see mug/licence.txt"
    assert find_licence(tmp_path / "bowl/bowl.obj", tmp_path, "unknown", files) == "see LICENSE"
    assert find_licence(tmp_path / "bowl/bowl.obj", tmp_path, "MIT", files) == "MIT"
    assert find_licence(tmp_path / "bowl/bowl.obj", tmp_path, "unknown", []) == "unknown"


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


TALL = CUBE.replace("v 0 1", "v 0 3").replace("v 1 1", "v 1 3")  # 1 x 3 x 1: +Y is up


def settings(**more):
    return ShapeNetSource(source="shapenet", folder=".", **more)


def version_2(root, category, model, text=TALL):
    return write(root / str(BUILT_IN[category].synset) / model / "models" / "model_normalized.obj", text)


def version_1(root, category, model, text=TALL):
    return write(root / str(BUILT_IN[category].synset) / model / "model.obj", text)


@pytest.mark.parametrize("layout", [version_1, version_2])
def test_both_layouts_are_read_and_y_becomes_z(tmp_path, layout):
    layout(tmp_path, "mug", "abc")
    listing = list_source(settings(), tmp_path, {"mug"}, LIMITS)
    asset = load_entry(settings(), listing.folder, listing.entries["mug"][0], "mug", ASSETS)
    assert asset.extents_m == pytest.approx([0.25, 0.25, 0.75])
    assert asset.instance_id == "03797390-abc"
    assert asset.watertight
    assert not asset.shareable
    # A point at the front of the model, -Z, has +y here; one above has +z.
    front, above = (asset.T_source_to_object[:3, :3] @ axis for axis in (np.array([0, 0, -1]), np.array([0, 1, 0])))
    assert front == pytest.approx([0, 1, 0])
    assert above == pytest.approx([0, 0, 1])


def test_tables_have_their_own_scale_and_a_setting_replaces_both(tmp_path):
    version_2(tmp_path, "table", "t")
    listing = list_source(settings(), tmp_path, {"table"}, LIMITS)
    entry = listing.entries["table"][0]
    assert load_entry(settings(), listing.folder, entry, "table", ASSETS).scale == 1.5
    assert load_entry(settings(scale=2.0), listing.folder, entry, "table", ASSETS).scale == 2.0


def test_models_without_a_usable_mesh_are_skipped_and_counted_by_reason(tmp_path):
    version_2(tmp_path, "mug", "good")
    version_2(tmp_path, "mug", "large", TALL * 3)
    (tmp_path / str(BUILT_IN["mug"].synset) / "empty").mkdir()
    listing = list_source(settings(), tmp_path, {"mug"}, MeshLimits(max_faces=17))
    assert [entry.instance_id for entry in listing.entries["mug"]] == ["03797390-good"]
    assert listing.skipped == {"missing": 1, "too_large": 1}


def test_textures_of_version_2_lie_beside_the_models_folder(tmp_path):
    mesh = version_2(tmp_path, "mug", "abc", "mtllib model_normalized.mtl\n" + TALL)
    write(mesh.with_suffix(".mtl"), "newmtl a\nmap_Kd ../images/texture0.jpg\n")
    write(mesh.parent.parent / "images" / "texture0.jpg", b"jpg")
    listing = list_source(settings(), tmp_path, {"mug"}, LIMITS)
    assert listing.entries["mug"][0].files[2].path.endswith("abc/images/texture0.jpg")


def test_a_folder_that_is_not_shapenet_is_refused_with_what_it_holds(tmp_path):
    with pytest.raises(AssetSourceError, match="is not a folder"):
        list_source(settings(), tmp_path / "none", {"mug"}, LIMITS)
    write(tmp_path / "readme.txt", "")
    with pytest.raises(AssetSourceError, match=r"none of the synset folders 03797390 \(mug\).*readme\.txt"):
        list_source(settings(), tmp_path, {"mug"}, LIMITS)


def test_shapenet_has_no_box(tmp_path):
    assert list_source(settings(), tmp_path, {"box"}, LIMITS).entries == {}
