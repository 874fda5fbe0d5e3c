"""Every reader on a dataset of captures, whose photographs and mirror views are exact (tests/captures.py)."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
import trimesh

from schemas.errors import CaptureError, CorruptError, InputError, MachineError
from services.read.audit import audit, verify_independently
from services.read.dataset_reader import find_scene
from services.read.query import query
from services.read.repair import repair
from services.read.replay import replay_scene
from services.read.scene_geometry import posed_scene
from services.read.status import read_status
from tests.captures import captures_job, use_exact_captures, write_folder
from tests.datasets import faults_of, make_dataset, run_here
from workers.capture import make_capture
from workers.capture import rows as capture_pair
from workers.store.local import LocalStore


@pytest.fixture(autouse=True)
def exact(monkeypatch):
    use_exact_captures(monkeypatch)


@pytest.fixture(scope="module")
def virtual(captures) -> Path:
    return captures.root


@pytest.fixture
def copy(virtual, tmp_path) -> LocalStore:
    shutil.copytree(virtual, tmp_path / "copy")
    return LocalStore(tmp_path / "copy")


def test_what_a_run_left_is_whole_by_both_derivations_and_is_made_again_to_the_byte(virtual):
    store = LocalStore(virtual)
    assert faults_of(store) == []
    found = verify_independently(store, 2, lambda _: None)
    assert (found.faults, found.pairs) == ([], 4)
    assert any("photographs" in line for line in found.underived)
    for scene_id in (0, 1):
        result = replay_scene(store, scene_id)
        assert (result.differences, result.same_stack) == ((), True) and result.compared > 20
    with pytest.raises(InputError, match="verso replay"):  # says why there is no audit
        audit(store, 1, lambda _: None)


def test_a_mirror_mask_beyond_what_was_seen_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(capture_pair, "REGION_NOTHING", 2)
    store, _ = run_here(captures_job(scenes=1), tmp_path / "out")
    assert [fault for fault in faults_of(store) if "regions where there is no depth" in fault]


def test_a_lost_image_and_a_lost_shape_are_named_and_made_again(copy):
    stored = find_scene(copy, 0)
    shape = copy.root / "assets/mug" / f"{stored.scene(0)['instance_id']}.glb"
    for damage in (lambda: shape.write_bytes(b"glTF"), shape.unlink):
        damage()
        with pytest.raises(CorruptError, match=f"{shape.name} .*--repair"):
            posed_scene(copy, 0)
    (copy.root / "mug/depth00001.png").unlink()
    assert len(faults_of(copy)) == 2
    found = repair(copy, [], lambda _: None)
    assert (len(found.done), found.left, found.verdict.faults) == (2, [], [])


def test_sql_status_and_the_card_tell_of_captures(virtual):
    store = LocalStore(virtual)
    sql = "select scene_id, source, capture.pose_mm as mm, penetration_mm from scenes"
    rows = [{"scene_id": n, "source": "simulated_capture", "mm": 0.2, "penetration_mm": None} for n in (0, 1)]
    assert query(store, sql).to_pylist() == rows
    sql = "select count(*) as n from views where capture.measured_share > 0.9"
    assert query(store, sql).to_pylist() == [{"n": 4}]
    assert (read_status(store, 0, 2).made, read_status(store, 0, 2).missing) == (2, 0)
    card = store.read("DATASET.md").decode()
    told = ("## Captures", "0 neither board nor object, 2 board, 3 object", "at most 4")
    assert all(words in card for words in told)


def test_geometry_of_a_capture_is_its_board_and_its_mesh_where_they_are(virtual):
    store = LocalStore(virtual)
    found = posed_scene(store, 0)
    board, thing = sorted(found.graph.nodes_geometry)
    assert (board.split()[0], thing.split()[0]) == ("board", "mug")
    np.testing.assert_allclose(found.geometry[board].extents, [0.6, 0.4, 0.0], atol=1e-7)
    placed = trimesh.transform_points(found.geometry[thing].vertices, found.graph[thing][0])
    assert placed[:, 2].min() == pytest.approx(0.0, abs=1e-6) and abs(placed[:, :2].mean()) < 0.05
    linear = round(255 * ((120 / 255 + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1, of the grey of its photographs
    assert np.abs(found.geometry[thing].visual.vertex_colors[0].astype(int) - [linear, linear, linear, 255]).max() <= 1


def test_folders_are_captures_and_one_that_cannot_be_used_is_a_row_of_failures(tmp_path, monkeypatch):
    for n in range(2):
        write_folder(tmp_path / "shots" / str(n), f"mug-{n}", truth=False)
    job = captures_job(captures={"folders": ["shots/0", "shots/1"]})
    usual, unusable = make_capture.process_capture, {"mug-1"}

    def process(folder, captures, watch):
        if folder.about.name in unusable:
            raise CaptureError("markers", f"{folder.path}: no marker")
        return usual(folder, captures, watch)

    monkeypatch.setattr(make_capture, "process_capture", process)
    store, _ = run_here(job, tmp_path / "out", tmp_path)
    (failure,) = pq.read_table(tmp_path / "out/manifest/failures").to_pylist()
    assert (failure["stage"], failure["kind"], failure["reason"]) == ("capture", "intrinsic", "markers")
    assert faults_of(store) == [] and store.read("job.yaml").decode().count("\n- ") >= 2
    unusable.add("mug-0")  # a dataset where every capture failed is finished and read
    none, _ = run_here(job, tmp_path / "none", tmp_path)
    assert faults_of(none) == []
    assert query(none, "select count(capture) as n from scenes").to_pylist() == [{"n": 0}]
    assert json.loads(none.read("_SUCCESS"))["scenes"]["intrinsic"] == 2
    (tmp_path / "shots/0/rgb_00000.png").write_bytes(b"")
    with pytest.raises(MachineError, match="captures in shots/0 "):
        replay_scene(store, 0)


def test_one_query_tells_captures_from_simulations_in_both_datasets(virtual, tmp_path):
    make_dataset(tmp_path, categories=["mug", "box"])
    both = (tmp_path, virtual)
    for order in (both, both[::-1]):
        scenes = ds.dataset([ds.dataset(one / "manifest/scenes", partitioning="hive") for one in order])
        rows = scenes.to_table(columns=["source", "category", "penetration_mm", "capture"]).to_pylist()
        kinds = sorted((row["source"], row["capture"] is not None, row["penetration_mm"] is None) for row in rows)
        assert kinds == [("procedural", False, False)] * 2 + [("simulated_capture", True, True)] * 2
        measured = scenes.to_table(filter=pc.is_valid(ds.field("capture")))
        assert measured.num_rows == 2

    for table in ("views", "objects", "assets", "failures", "timings"):
        parts = [ds.dataset(one / "manifest" / table, partitioning="hive") for one in both]
        assert ds.dataset(parts).count_rows() == sum(part.count_rows() for part in parts), table
