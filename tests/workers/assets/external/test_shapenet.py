"""ShapeNetCore's two layouts, made up here: nothing of ShapeNet is in the repository."""

import numpy as np
import pytest

from schemas.errors import AssetSourceError
from schemas.job.assets import Assets, MeshLimits, ShapeNetSource
from schemas.job.category import BUILT_IN
from tests.workers.assets.oracles import CUBE, write
from workers.assets.catalogue import list_source
from workers.assets.external.placement import load_entry

LIMITS, ASSETS = MeshLimits(), Assets(density_kg_m3=600.0, shell_kg_m2=3.0)
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
