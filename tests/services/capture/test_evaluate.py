"""`verso capture evaluate`, by the command line."""

import json
import shutil

import pytest
import trimesh

from services.cli.main import main
from tests.workers.pipeline.captures.small_capture import copy_of, processed

KEYS = ("pose_mm", "pose_deg", "cloud_median_mm", "cloud_p95_mm", "completeness", "depth_median_mm")


@pytest.mark.minute
def test_a_simulated_capture_is_scored_against_its_truth(capsys):
    assert main(["capture", "evaluate", str(processed()[0]), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert all(isinstance(answer[key], float) for key in KEYS) and answer["aligned_by"] is None
    assert answer["cloud_median_mm"] < 1.0 and answer["completeness"] > 0.9 and answer["pose_mm"] < 2.0
    assert len(answer["held_out"]) == 6


def test_a_given_mesh_is_aligned_first_and_that_is_said(tmp_path, capsys):
    path = copy_of(processed()[0], tmp_path)
    mesh = trimesh.load(path / "truth" / "mesh.glb", force="mesh", process=False)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(1.0, (0, 0, 1)))
    mesh.apply_translation((1, 2, 3))
    mesh.export(tmp_path / "given.ply")
    shutil.rmtree(path / "truth")
    assert main(["capture", "evaluate", str(path), "--mesh", str(tmp_path / "given.ply"), "--json"]) == 0
    out = capsys.readouterr().out
    answer = json.loads(out.splitlines()[-1])
    assert "aligned to the cloud by ICP" in out and answer["aligned_by"] == "icp"
    assert answer["pose_mm"] is None and answer["cloud_median_mm"] < 1.0 and answer["completeness"] > 0.9
    assert main(["capture", "evaluate", str(path)]) != 0
    assert "--mesh" in capsys.readouterr().err
