"""Every reader on a dataset of captures, whose photographs and mirror views are exact (tests/captures.py)."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh

from schemas.errors import CaptureError, InputError, MachineError
from schemas.job.job import Job
from services.read.audit import audit, verify_independently
from services.read.contact_sheet import draw_sheet
from services.read.dataset_reader import find_scene
from services.read.query import query
from services.read.repair import repair
from services.read.replay import replay_scene
from services.read.scene_geometry import captured_geometry, export_scene
from services.read.status import read_status
from tests.captures import captures_job, use_exact_captures, write_folder
from tests.datasets import faults_of, run_here
from workers.capture import make_capture
from workers.capture import rows as capture_pair
from workers.store.local import LocalStore


@pytest.fixture(autouse=True)
def exact(monkeypatch):
    use_exact_captures(monkeypatch)


@pytest.fixture(scope="module")
def virtual(tmp_path_factory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        use_exact_captures(patch)
        out = tmp_path_factory.mktemp("virtual")
        run_here(captures_job(), out)
    return out


@pytest.fixture
def copy(virtual, tmp_path) -> LocalStore:
    shutil.copytree(virtual, tmp_path / "copy")
    return LocalStore(tmp_path / "copy")


def folder_job(tmp_path: Path) -> Job:
    for n in range(2):
        write_folder(tmp_path / "shots" / str(n), f"mug-{n}", truth=False)
    return captures_job(captures={"source": "folders", "folders": ["shots/0", "shots/1"]})


def test_what_a_run_left_is_whole_by_both_derivations(virtual):
    store = LocalStore(virtual)
    assert faults_of(store) == []
    found = verify_independently(store, 2, lambda _: None)
    assert (found.faults, found.pairs) == ([], 4)
    assert any("photographs" in line for line in found.underived)


def test_a_mirror_mask_beyond_what_was_seen_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(capture_pair, "REGION_NOTHING", 2)
    store, _ = run_here(captures_job(scenes=1), tmp_path / "out")
    assert [fault for fault in faults_of(store) if "regions where there is no depth" in fault]


def test_a_lost_image_and_a_lost_shape_are_made_again(copy):
    shape = next(Path(copy.root).glob("assets/mug/*.glb"))
    for path in (Path(copy.root) / "mug/depth00001.png", shape):
        path.unlink()
    assert len(faults_of(copy)) == 2
    found = repair(copy, [], lambda _: None)
    assert (len(found.done), found.left, found.verdict.faults) == (2, [], [])


def test_a_capture_is_made_again_to_the_byte(virtual):
    for scene_id in (0, 1):
        result = replay_scene(LocalStore(virtual), scene_id)
        assert (result.differences, result.same_stack) == ((), True)
        assert result.compared > 20


def test_a_run_that_was_cut_off_between_captures_goes_on_to_the_same_digest(virtual, tmp_path, monkeypatch):
    usual = make_capture.process_capture

    def cut_off(folder, captures, watch):
        if folder.about.name == "mug-1":
            raise KeyboardInterrupt
        return usual(folder, captures, watch)

    with monkeypatch.context() as patch:
        patch.setattr(make_capture, "process_capture", cut_off)
        with pytest.raises(KeyboardInterrupt):
            run_here(captures_job(), tmp_path)
    assert len(list(tmp_path.glob("manifest/_commits/*.json"))) == 1
    _, digest = run_here(captures_job(), tmp_path)
    assert digest == json.loads((virtual / "_SUCCESS").read_text())["digest"]


def test_an_audit_says_why_there_is_none(virtual):
    with pytest.raises(InputError, match="verso replay"):
        audit(LocalStore(virtual), 1, lambda _: None)


def test_sql_sees_quality_of_captures(virtual):
    rows = query(
        LocalStore(virtual), "select scene_id, source, capture.pose_mm as mm, penetration_mm from scenes"
    ).to_pylist()
    assert rows == [{"scene_id": n, "source": "simulated_capture", "mm": 0.2, "penetration_mm": None} for n in (0, 1)]
    (row,) = query(
        LocalStore(virtual), "select count(*) as n from views where capture.measured_share > 0.9"
    ).to_pylist()
    assert row == {"n": 4}


def test_status_and_card_and_sheet_of_captures(virtual):
    store = LocalStore(virtual)
    assert (read_status(store, 0, 2).made, read_status(store, 0, 2).missing) == (2, 0)
    card = store.read("DATASET.md").decode()
    assert "## Captures" in card
    assert "0 neither board nor object, 2 board, 3 object" in card
    assert "at most 4" in card
    assert draw_sheet(store, 2).width > 1000


def test_geometry_of_a_capture_is_its_board_and_its_mesh_where_they_are(virtual, tmp_path):
    store = LocalStore(virtual)
    assert export_scene(store, 0, tmp_path / "c.glb") > 1000
    stored = find_scene(store, 0)
    board, thing = captured_geometry(store, stored, stored.scene(0))
    np.testing.assert_allclose(board[1].extents, [0.6, 0.4, 0.0], atol=1e-12)
    placed = trimesh.transform_points(thing[1].vertices, thing[2])
    assert placed[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert abs(placed[:, :2].mean()) < 0.05
    assert thing[1].visual.vertex_colors[0].tolist() == [120, 120, 120, 255]


def test_folders_are_captures_and_one_that_cannot_be_used_is_a_row_of_failures(tmp_path, monkeypatch):
    job = folder_job(tmp_path)
    usual = make_capture.process_capture

    def process(folder, captures, watch):
        if folder.about.name == "mug-1":
            raise CaptureError("markers", f"{folder.path}: no marker")
        return usual(folder, captures, watch)

    monkeypatch.setattr(make_capture, "process_capture", process)
    store, _ = run_here(job, tmp_path / "out", tmp_path)
    (failure,) = pq.read_table(tmp_path / "out/manifest/failures").to_pylist()
    assert (failure["stage"], failure["kind"], failure["reason"]) == ("capture", "intrinsic", "markers")
    assert faults_of(store) == []
    job_file = store.read("job.yaml").decode()
    assert job_file.count("\n- ") >= 2
    (tmp_path / "shots/0/rgb_00000.png").write_bytes(b"")
    with pytest.raises(MachineError, match="captures in shots/0 "):
        replay_scene(store, 0)


def test_a_dataset_where_every_capture_failed_is_finished_and_read(tmp_path, monkeypatch):
    def process(folder, captures, watch):
        raise CaptureError("markers", "none")

    monkeypatch.setattr(make_capture, "process_capture", process)
    store, _ = run_here(captures_job(), tmp_path / "out")
    assert faults_of(store) == []
    assert query(store, "select count(capture) as n from scenes").to_pylist() == [{"n": 0}]
    assert json.loads(store.read("_SUCCESS"))["scenes"]["intrinsic"] == 2
