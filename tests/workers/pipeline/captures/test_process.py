"""A processed folder: what is written, that it is right, and that a second run writes the same."""

import json

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from schemas.errors import CaptureError
from tests.workers.pipeline.captures.small_capture import CAPTURES, VIEWS, copy_of, made, processed
from workers.capture.folder import read_pose, read_truth, write_pose
from workers.capture.process import process_folder
from workers.capture.results import read_cloud
from workers.geometry.frames import translation


def results(path):
    """Bytes of what processing wrote, the seconds left out."""
    record = json.loads((path / "process.json").read_bytes())
    return {name: (path / name).read_bytes() for name in record["files"]} | {"record": record | {"seconds": None}}


def test_every_view_has_its_files_and_process_json_names_them():
    path, done = processed()
    record = json.loads((path / "process.json").read_bytes())
    expected = {
        f"{kind}_{n:05d}.{end}" for n in range(VIEWS) for kind, end in (("board", "txt"), ("correction", "txt"))
    }
    expected |= {f"mask_{n:05d}.png" for n in range(VIEWS)} | {"cloud.ply", "mesh.ply", "poses.parquet"}
    assert set(record["files"]) == expected
    assert len(read_cloud(path)[0]) == record["cloud_points"] == len(done.merged.surface.points)
    assert {"poses_detect", "poses_joint", "read", "fuse", "masks", "total"} <= set(record["seconds"])
    assert pq.read_table(path / "poses.parquet").num_rows == 3 * VIEWS
    assert record["settings"]["fusion"]["voxel_m"] == 0.002


def test_poses_in_the_files_are_near_the_truth():
    path, _ = processed()
    truth = read_truth(path)
    for n in range(VIEWS):
        T = read_pose(path / f"correction_{n:05d}.txt") @ read_pose(path / f"board_{n:05d}.txt")
        assert np.linalg.norm(T[:3, 3] - truth.T_board_cam[n][:3, 3]) < 0.003


def test_masks_are_the_objects_pixels():
    path, _ = processed()
    for n in range(VIEWS):
        mask, truth = (cv2.imread(str(p / f"mask_{n:05d}.png"), 0) > 0 for p in (path, path / "truth"))
        assert (mask & truth).sum() / (mask | truth).sum() > 0.93


def test_a_second_run_writes_the_same_bytes(tmp_path):
    path = copy_of(processed()[0], tmp_path)
    process_folder(path, CAPTURES)
    assert results(path) == results(processed()[0])
    assert not list(path.glob(".*"))


def test_a_manual_correction_and_a_given_mask_are_respected_and_stay(tmp_path):
    path = copy_of(processed()[0], tmp_path)
    moved = translation(0.002, 0.0, 0.0) @ read_pose(path / "correction_00001.txt")
    write_pose(path / "correction_00001.txt", moved)
    given = np.where(cv2.imread(str(path / "truth" / "mask_00002.png"), 0) > 0, 255, 0).astype(np.uint8)
    given[:, :5] = 255
    cv2.imwrite(str(path / "mask_00002.png"), given)
    done = process_folder(path, CAPTURES)
    assert done.users == ("correction_00001.txt", "mask_00002.png")
    assert "1 pose from manual corrections" in done.notes
    final = done.estimates.estimate.views[1].T_board_cam
    assert np.allclose(final, moved @ read_pose(path / "board_00001.txt"), atol=1e-12)
    assert np.array_equal(cv2.imread(str(path / "mask_00002.png"), 0), given)
    assert "mask_00002.png" not in json.loads((path / "process.json").read_bytes())["files"]


def test_a_capture_that_is_refused_keeps_its_folder_as_it_was(tmp_path):
    path = copy_of(made(), tmp_path)
    for n in range(VIEWS):
        cv2.imwrite(str(path / f"depth_{n:05d}.png"), np.zeros((378, 672), np.uint16))
    before = sorted(file.name for file in path.iterdir())
    with pytest.raises(CaptureError) as refusal:
        process_folder(path, CAPTURES)
    assert refusal.value.reason == "no_depth"
    assert sorted(file.name for file in path.iterdir()) == before
