"""What Python reads of a dataset, in every form, against the plain files of one."""

import json
import pickle
import subprocess
import sys
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pytest

from schemas.errors import CorruptError, InputError, OutputError
from services.dataset import shapes as stored_files
from services.dataset.dataset import Dataset, open_dataset
from tests.datasets import make_dataset
from workers.store.local import LocalStore

WORDS = {
    "input": {"RGB": "RGB", "depth": "depth", "segment": "segment"},
    "aligned": {"RGB": "RGBaligned", "depth": "depthAligned", "segment": "segmentAligned"},
    "mirror": {"RGB": "RGB", "depth": "depth", "segment": "segment"},
    "projected": {"RGB": "RGBprojected", "depth": "depthProjected"},
}
"""Content words of the article's figure 1."""


def plain(root: Path, table: str) -> list[dict]:
    """The rows of a merged table, by pyarrow alone."""
    return ds.dataset(root / "manifest" / table, partitioning="hive").to_table().to_pylist()


def imread(path):
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return image[..., ::-1] if image.ndim == 3 else image


def test_every_pair_has_the_facts_and_the_pixels_of_the_files(dataset, files):
    views = {(row["parent_id"], row["role"]): row for row in plain(files.root, "views")}
    scenes = {row["scene_id"]: row for row in plain(files.root, "scenes")}
    assets = {row["instance_id"]: row for row in plain(files.root, "assets")}
    pairs, patches = list(dataset.pairs()), 0
    assert [pair.pose_id for pair in pairs] == sorted({parent for parent, _ in views}) and len(pairs) == 8
    for pair in pairs:
        assert pair.scene == scenes[pair.scene_id] and pair.asset == assets[pair.instance_id]
        for role, number in (("input", 0), ("aligned", 0), ("mirror", 1), ("projected", 0)):
            view, row = getattr(pair, role), views[pair.pose_id, role]
            assert (view.role, view.pose_id, view.row) == (role, row["pose_id"], row)
            assert view.T_world_cam.ravel().tolist() == row["T_world_cam"]
            assert view.K[:2, 2].tolist() == [row["cx"], row["cy"]] == (view.K_opencv[:2, 2] + 0.5).tolist()
            folder = files.root / pair.category
            name = {kind: f"{word}{pair.pose_id + number:05d}.png" for kind, word in WORDS[role].items()}
            depth = imread(folder / name["depth"])
            assert np.array_equal(view.rgb(), imread(folder / name["RGB"])) and np.array_equal(view.depth(), depth)
            assert np.allclose(view.depth_m(), depth / 5000.0, rtol=0, atol=1e-6)
            patch, stored = view.patch(), folder / "patches" / name["RGB"]
            assert (patch is not None) == stored.exists()
            if patch is not None:  # the crop that its intrinsics tell
                assert np.array_equal(patch.rgb(), imread(stored))
                column, line = np.round(view.K[:2, 2] - patch.K[:2, 2]).astype(int)
                height, width = patch.depth().shape
                assert np.array_equal(patch.depth(), depth[line : line + height, column : column + width])
                assert (patch.camera.intrinsics.width, patch.camera.intrinsics.height) == (width, height)
                patches += 1
            if role != "projected":
                segment = imread(folder / name["segment"])
                assert np.array_equal(view.segment(), segment)
                (label,) = [one for one in view.objects if one.region_id == 3]
                assert label.pixels == (segment == 3).sum()
    assert patches


FILTERS = (
    (pc.field("category") == "can", lambda scene, first, asset: scene["category"] == "can"),
    (pc.field("input", "visible_fraction") > 0.999, lambda scene, first, asset: first["visible_fraction"] > 0.999),
    (
        pc.match_substring(pc.binary_join(pc.field("effects"), " "), "table_texture"),
        lambda scene, first, asset: any("table_texture" in name for name in scene["effects"]),
    ),
    (pc.field("asset", "split") == "train", lambda scene, first, asset: asset["split"] == "train"),
    (pc.field("scene_id").isin([0, 3]), lambda scene, first, asset: scene["scene_id"] in (0, 3)),
    (pc.field("input", "yaw_rad") > 9.0, lambda scene, first, asset: False),
)


def test_filters_parts_and_ids_choose_pairs_and_tables_are_whole(dataset, files, monkeypatch):
    scenes = {row["scene_id"]: row for row in plain(files.root, "scenes")}
    assets = {row["instance_id"]: row for row in plain(files.root, "assets")}
    first = sorted(
        (row for row in plain(files.root, "views") if row["role"] == "input"), key=lambda row: row["pose_id"]
    )
    for where, keeps in FILTERS:
        of = [(row, scenes[row["scene_id"]]) for row in first]
        expected = [row["pose_id"] for row, scene in of if keeps(scene, row, assets[scene["instance_id"]])]
        assert [pair.pose_id for pair in dataset.pairs(where)] == expected
    parts = [[pair.pose_id for pair in dataset.pairs(part=(k, 2))] for k in range(2)]
    assert sorted([*parts[0], *parts[1]]) == [row["pose_id"] for row in first] and all(parts)
    assert [dataset.pair(number).pose_id for number in (2, 3, 14, 15)] == [2, 2, 14, 14]
    monkeypatch.setattr("services.dataset.dataset.KEPT_BYTES", 1)  # a range may have more rows than are kept
    assert [Dataset(dataset._store).pair(number).pose_id for number in (14, 2)] == [14, 2]
    assert [pair.pose_id for pair in dataset.scene(1)] == [4, 6]
    with pytest.raises(InputError, match="scene 4 is not in"):
        dataset.pair(16)
    for name in ("scenes", "views", "objects", "failures", "timings"):
        assert dataset.table(name).count_rows() == len(plain(files.root, name))
    assert set(dataset.table("assets").to_table()["instance_id"].to_pylist()) == assets.keys()
    cans = dataset.table("views").to_table(filter=pc.field("category") == "can", columns=["pose_id", "category"])
    assert cans.num_rows and set(cans["category"].to_pylist()) == {"can"}


def test_what_is_wrong_is_told_at_once_and_clearly(files, tmp_path):
    dataset = open_dataset(str(files.root))
    (pair, *_) = dataset.pairs()
    for error, told, call in (
        (InputError, "no table 'view'; did you mean 'views'", lambda: dataset.table("view")),
        (
            InputError,
            r"catgory.*Columns of a pair: scene_id, category",
            lambda: dataset.pairs(pc.field("catgory") == 1),
        ),
        (InputError, "filter cannot be used", lambda: dataset.pairs(pc.field("input", "nothing") > 1)),
        (InputError, "filter cannot be used", lambda: dataset.pairs(pc.field("category") == 1)),
        (InputError, "part", lambda: dataset.pairs(part=(2, 2))),
        (OutputError, "there is no such folder", lambda: open_dataset(tmp_path / "nowhere")),
        (InputError, "no image of kind 'region', only rgb, depth", lambda: pair.projected.segment()),
        (InputError, r"region 9 is no object of this view; its objects are \[3\]", lambda: pair.input.patch(region=9)),
        (InputError, r"has the regions \[2, 3\], and no 1", lambda: pair.mesh(region=1)),
    ):
        with pytest.raises(error, match=told):
            call()


def test_nothing_of_a_pair_can_be_changed_and_a_dataset_travels_to_other_processes(files):
    dataset = pickle.loads(pickle.dumps(open_dataset(files.root)))
    (pair, *others) = dataset.pairs()
    assert dataset.is_finished and len(others) == 7
    with pytest.raises(AttributeError):
        pair.category = "box"
    with pytest.raises(TypeError):
        pair.scene["category"] = "box"
    with pytest.raises(ValueError, match="read-only"):
        pair.input.T_world_cam[0, 0] = 1.0
    before = pair.input.rgb()
    pair.input.rgb()[:] = 0
    assert np.array_equal(pair.input.rgb(), before)


def test_a_missing_image_is_named(copy, tars):
    for path in (copy / "can").glob("depth0*.png"):
        path.unlink()
    (pair, *_) = open_dataset(copy).pairs(pc.field("category") == "can")
    with pytest.raises(CorruptError, match=r"can/depth\d+\.png is committed and missing"):
        pair.input.depth()
    (pair, *_) = Dataset(LocalStore(tars.root)).pairs()
    with pytest.raises(CorruptError, match=r"can/RGB99999\.png is committed and in no tar: `verso verify"):
        pair._files.image("can/RGB99999.png")


def test_captures_are_pairs_as_scenes_are(captures):
    dataset = open_dataset(captures.root)
    pairs = list(dataset.pairs(pc.is_valid(pc.field("capture"))))
    assert len(pairs) == 4 and all(pair.aligned is None and pair.mirror.depth().any() for pair in pairs)
    assert [dataset.pair(pair.pose_id).scene["capture"] for pair in pairs] == [pair.scene["capture"] for pair in pairs]
    low, high = pairs[0].mesh().bounds
    assert (high - low).max() > 0.05


def test_views_that_the_job_switched_off_are_none(tmp_path):
    off = {"enabled": False}
    changes = {"cameras": {"depth": off, "mirror": off}, "images": {"projection": off}, "render": {"rgb": False}}
    store, _ = make_dataset(tmp_path, scenes=1, **changes)
    (pair,) = open_dataset(store.root).pairs()
    assert (pair.aligned, pair.mirror, pair.projected) == (None, None, None)
    assert set(pair.input.images) == {"depth", "region"}
    assert repr(pair) == f"Pair(pose_id=0, scene_id=0, category={pair.category!r}, instance_id={pair.instance_id!r})"


class Counting(LocalStore):
    """Counts what is read of each key."""

    def __init__(self, root) -> None:
        super().__init__(root)
        self.reads: Counter[str] = Counter()

    def read(self, key: str) -> bytes:
        self.reads[key] += 1
        return super().read(key)


def test_a_tar_is_read_once_while_it_is_used_and_what_is_kept_is_bounded_by_its_bytes(tars, monkeypatch):
    store = Counting(tars.root)
    (first, *others) = Dataset(store).pairs()
    assert not any(key.endswith((".tar", ".png")) for key in store.reads)  # before an image is asked for
    first.input.rgb()
    assert [key for key in store.reads if key.endswith(".tar")] == [f"{first.category}/0000000000.tar"]
    whole = [view.depth().sum() for pair in (first, *others) for view in (pair.input, pair.mirror)]
    read = {key: count for key, count in store.reads.items() if key.endswith(".tar")}
    assert len(read) > 1 and set(read.values()) == {1}
    monkeypatch.setattr(stored_files, "TAR_BYTES", 1)
    store = Counting(tars.root)
    assert [view.depth().sum() for pair in Dataset(store).pairs() for view in (pair.input, pair.mirror)] == whole
    assert max(count for key, count in store.reads.items() if key.endswith(".tar")) > 1


STREAM = """
import json, sys
from tests.kit.memory import peak_mib
from pathlib import Path
from services.dataset.dataset import Dataset
from services.job.job_file import validate_job
from services.job.record import encode_job, record_job
from tests.datasets import SMALL
from tests.kit.many_ranges import ManyRanges

def stream(root, ranges):
    store = ManyRanges(root, ranges)
    store.prepare()
    store.put("job.yaml", encode_job(record_job(validate_job(SMALL, "test"), "c" * 64, root)))
    pairs = sum(1 for pair in Dataset(store).pairs() if pair.mirror.images)
    return pairs, peak_mib()

print(json.dumps([stream(Path(sys.argv[1]) / "few", 100), stream(Path(sys.argv[1]) / "many", 500)]))
"""


@pytest.mark.minute
def test_five_times_the_pairs_take_no_more_memory(tmp_path, record_figure):
    done = subprocess.run([sys.executable, "-c", STREAM, str(tmp_path)], capture_output=True, text=True, check=True)
    (few, before), (many, after) = json.loads(done.stdout)
    assert many > 4 * few > 300
    record_figure("stream_pairs_growth_mib", "passed", after - before, 8.0)
    assert after - before < 8.0
