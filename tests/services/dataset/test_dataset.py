"""What Python reads of a dataset, in every form, against the plain files of one."""

import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pytest

from schemas.errors import CorruptError, InputError, OutputError
from services.dataset.dataset import open_dataset
from tests.captures import captures_job, use_exact_captures
from tests.datasets import run_here

WORDS = {
    "input": {"RGB": "RGB", "depth": "depth", "segment": "segment"},
    "aligned": {"RGB": "RGBaligned", "depth": "depthAligned", "segment": "segmentAligned"},
    "mirror": {"RGB": "RGB", "depth": "depth", "segment": "segment"},
    "projected": {"RGB": "RGBprojected", "depth": "depthProjected"},
}
"""Content words of the article's figure 1."""


def plain_views(root: Path) -> dict[tuple[int, str], dict]:
    """Rows of `views` by (parent id, role), by pyarrow alone."""
    rows = ds.dataset(root / "manifest/views", partitioning="hive").to_table().to_pylist()
    return {(row["parent_id"], row["role"]): row for row in rows}


def test_every_pair_has_the_facts_and_the_pixels_of_the_files(dataset, files):
    views = plain_views(files.root)
    pairs = list(dataset.pairs())
    assert [pair.pose_id for pair in pairs] == sorted({parent for parent, _ in views}) and len(pairs) == 8
    for pair in pairs:
        for role, number in (("input", 0), ("aligned", 0), ("mirror", 1), ("projected", 0)):
            view, row = getattr(pair, role), views[pair.pose_id, role]
            assert (view.role, view.pose_id, view.row["d_z_m"]) == (role, row["pose_id"], row["d_z_m"])
            assert view.T_world_cam.ravel().tolist() == row["T_world_cam"]
            assert view.K[:2, 2].tolist() == [row["cx"], row["cy"]] == (view.K_opencv[:2, 2] + 0.5).tolist()
            stem = lambda word, at=pair.pose_id + number, of=WORDS[role]: f"{of[word]}{at:05d}.png"  # noqa: E731
            folder = files.root / pair.category
            rgb = cv2.imread(str(folder / stem("RGB")))[..., ::-1]
            depth = cv2.imread(str(folder / stem("depth")), cv2.IMREAD_UNCHANGED)
            assert np.array_equal(view.rgb(), rgb) and np.array_equal(view.depth(), depth)
            assert view.depth_m() == pytest.approx(depth / 5000.0, abs=1e-6)
            patch = view.patch()
            stored = folder / "patches" / stem("RGB")
            assert (patch is not None) == stored.exists()
            if patch is not None:
                assert np.array_equal(patch.rgb(), cv2.imread(str(stored))[..., ::-1])
            if role != "projected":
                segment = cv2.imread(str(folder / stem("segment")), cv2.IMREAD_UNCHANGED)
                assert np.array_equal(view.segment(), segment)
                (label,) = [one for one in view.objects if one.region_id == 3]
                assert label.pixels == (segment == 3).sum()


def test_a_patch_is_the_crop_that_its_intrinsics_tell(dataset):
    seen = 0
    for pair in dataset.pairs():
        view = pair.mirror
        patch = view.patch()
        if patch is None:
            continue
        column, row = np.round(view.K[:2, 2] - patch.K[:2, 2]).astype(int)
        height, width = patch.depth().shape
        assert np.array_equal(patch.depth(), view.depth()[row : row + height, column : column + width])
        assert (patch.camera.intrinsics.width, patch.camera.intrinsics.height) == (width, height)
        seen += 1
    assert seen


@pytest.mark.parametrize(
    ("where", "keeps"),
    [
        (pc.field("category") == "mug", lambda scene, first, asset: scene["category"] == "mug"),
        (pc.field("input", "visible_fraction") > 0.999, lambda scene, first, asset: first["visible_fraction"] > 0.999),
        (
            pc.match_substring(pc.binary_join(pc.field("effects"), " "), "table_texture"),
            lambda scene, first, asset: any("table_texture" in name for name in scene["effects"]),
        ),
        (pc.field("asset", "split") == "train", lambda scene, first, asset: asset["split"] == "train"),
        (pc.field("scene_id").isin([0, 3]), lambda scene, first, asset: scene["scene_id"] in (0, 3)),
        (pc.field("input", "yaw_rad") > 9.0, lambda scene, first, asset: False),
    ],
)
def test_a_filter_keeps_what_the_tables_say(dataset, files, where, keeps):
    tables = {
        name: ds.dataset(files.root / "manifest" / name, partitioning="hive").to_table().to_pylist()
        for name in ("scenes", "assets")
    }
    scenes = {row["scene_id"]: row for row in tables["scenes"]}
    assets = {row["instance_id"]: row for row in tables["assets"]}
    expected = [
        parent
        for (parent, role), row in sorted(plain_views(files.root).items())
        if role == "input" and keeps(scenes[row["scene_id"]], row, assets[scenes[row["scene_id"]]["instance_id"]])
    ]
    assert [pair.pose_id for pair in dataset.pairs(where)] == expected


def test_parts_share_all_pairs_and_one_pair_is_found_by_either_id(dataset):
    whole = [pair.pose_id for pair in dataset.pairs()]
    parts = [[pair.pose_id for pair in dataset.pairs(part=(k, 2))] for k in range(2)]
    assert sorted([*parts[0], *parts[1]]) == whole and all(parts)
    assert [dataset.pair(number).pose_id for number in (2, 3, 14, 15)] == [2, 2, 14, 14]
    assert [pair.pose_id for pair in dataset.scene(1)] == [4, 6]
    with pytest.raises(InputError, match="scene 4 is not in"):
        dataset.pair(16)


def test_tables_are_whole_and_filter_by_expression(dataset, files):
    for name in ("scenes", "views", "objects", "failures", "timings"):
        merged = ds.dataset(files.root / "manifest" / name, partitioning="hive")
        assert dataset.table(name).count_rows() == merged.count_rows()
    mugs = dataset.table("views").to_table(filter=pc.field("category") == "mug", columns=["pose_id", "category"])
    assert mugs.num_rows and set(mugs["category"].to_pylist()) == {"mug"}
    assert set(dataset.table("assets").to_table()["instance_id"].to_pylist()) == set(
        ds.dataset(files.root / "manifest/assets", partitioning="hive").to_table()["instance_id"].to_pylist()
    )
    with pytest.raises(InputError, match="no table 'view'; did you mean 'views'"):
        dataset.table("view")


def test_what_is_wrong_is_told_at_once_and_clearly(files, tmp_path):
    dataset = open_dataset(str(files.root))
    with pytest.raises(InputError, match=r"catgory.*Columns of a pair: scene_id, category"):
        dataset.pairs(pc.field("catgory") == "mug")
    with pytest.raises(InputError, match="filter cannot be used"):
        dataset.pairs(pc.field("input", "nothing") > 1)
    with pytest.raises(InputError, match="part"):
        dataset.pairs(part=(2, 2))
    with pytest.raises(OutputError, match=r"holds no job\.yaml"):
        open_dataset(tmp_path / "nowhere")
    (pair, *_) = dataset.pairs()
    with pytest.raises(InputError, match="no image of kind 'region', only rgb, depth"):
        pair.projected.segment()
    with pytest.raises(InputError, match="region 9 is no object of this view; its objects are \\[3\\]"):
        pair.input.patch(9)
    with pytest.raises(InputError, match="has the regions \\[2, 3\\], and no 1"):
        pair.mesh(1)


def test_nothing_of_a_pair_can_be_changed(dataset):
    (pair, *_) = dataset.pairs()
    with pytest.raises(AttributeError):
        pair.category = "box"
    with pytest.raises(TypeError):
        pair.scene["category"] = "box"
    with pytest.raises(ValueError, match="read-only"):
        pair.input.T_world_cam[0, 0] = 1.0
    before = pair.input.rgb()
    pair.input.rgb()[:] = 0
    assert np.array_equal(pair.input.rgb(), before)


def test_a_missing_image_is_named(files, tmp_path):
    shutil.copytree(files.root, tmp_path / "copy")
    next((tmp_path / "copy/mug").glob("depth0*.png")).unlink()
    mugs = list(open_dataset(tmp_path / "copy").pairs(pc.field("category") == "mug"))
    with pytest.raises(CorruptError, match=r"mug/depth\d+\.png is committed and missing"):
        [view.depth() for pair in mugs for view in (pair.input, pair.mirror)]


def test_it_travels_to_other_processes(files):
    dataset = pickle.loads(pickle.dumps(open_dataset(files.root)))
    assert dataset.is_finished and sum(1 for _ in dataset.pairs()) == 8


def test_captures_are_pairs_as_scenes_are(tmp_path, monkeypatch):
    use_exact_captures(monkeypatch)
    run_here(captures_job(), tmp_path)
    dataset = open_dataset(tmp_path)
    pairs = list(dataset.pairs(pc.is_valid(pc.field("capture"))))
    assert len(pairs) == 4 and all(pair.aligned is None and pair.mirror.depth().any() for pair in pairs)
    assert [dataset.pair(pair.pose_id).scene["capture"] for pair in pairs] == [pair.scene["capture"] for pair in pairs]
    low, high = pairs[0].mesh().bounds
    assert (high - low).max() > 0.05
