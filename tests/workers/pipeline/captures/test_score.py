"""Scores of a processed capture: small for what is right, and as large as what was made wrong."""

import dataclasses

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.errors import CaptureError
from schemas.scene.shape import Mesh
from tests.workers.pipeline.captures.small_capture import made, processed
from workers.capture.folder import open_folder
from workers.capture.score import read_mesh_file, read_whole_truth, score_capture, score_measured, score_surface
from workers.capture.stored import read_result
from workers.geometry.frames import translation


def test_the_score_of_a_good_capture_is_good():
    result = read_result(processed()[0])
    score = score_capture(result.estimate, result.surface, result.views, read_whole_truth(result.folder), held_out=3)
    one = score.summary
    assert one.pose_mm < 2.0 and one.pose_deg < 0.2
    assert one.cloud_median_mm < 1.0 and one.cloud_p95_mm < 3.0 and one.completeness > 0.9
    assert one.depth_median_mm < 1.5
    assert sorted(score.held_out) == [0, 4, 9] and set(one.views) == set(range(10))
    assert one.views[4].depth_median_mm == score.held_out[4].depth_median_mm
    assert one.views[5].depth_median_mm is None
    assert score.worst_mm >= one.pose_mm


def test_poses_that_are_off_are_told_by_as_much():
    result = read_result(processed()[0])
    truth = read_whole_truth(result.folder)
    views = tuple(
        dataclasses.replace(
            view, T_board_cam=frozen_array(translation(0.0, 0.007, 0.0) @ truth.T_board_cam[view.number])
        )
        for view in result.estimate.views
    )
    estimate = dataclasses.replace(result.estimate, views=views)
    score = score_capture(estimate, result.surface, result.views, truth, held_out=1)
    assert score.summary.pose_mm == pytest.approx(7.0) and score.summary.pose_deg == pytest.approx(0.0, abs=1e-6)


def test_a_cloud_that_is_off_and_one_that_lacks_a_half_are_told():
    result = read_result(processed()[0])
    truth = read_whole_truth(result.folder)
    cameras = [result.views.posed(n).camera for n in range(3)]
    good = score_surface(result.surface, truth.surface, cameras)
    inflated = dataclasses.replace(result.surface, points=result.surface.points + 0.004 * result.surface.normals)
    assert score_surface(inflated, truth.surface, cameras).cloud_median_mm == pytest.approx(4.0, abs=0.5)
    keep = result.surface.points[:, 0] > np.median(result.surface.points[:, 0])
    half = dataclasses.replace(result.surface, points=result.surface.points[keep])
    assert 0.25 < score_surface(half, truth.surface, cameras).completeness < 0.75 < good.completeness


def test_what_had_depth_is_told_from_what_was_visible():
    result = read_result(processed()[0])
    truth = read_whole_truth(result.folder)
    depth = score_measured(result.surface, result.views, truth)
    assert 0.9 < depth.measured_of_visible <= 1.0 and depth.completeness_of_measured > 0.95
    keep = result.surface.points[:, 0] > np.median(result.surface.points[:, 0])
    half = dataclasses.replace(result.surface, points=result.surface.points[keep])
    spoilt = score_measured(half, result.views, truth)
    assert spoilt.measured_of_visible == depth.measured_of_visible and 0.3 < spoilt.completeness_of_measured < 0.7


def test_the_true_surface_is_that_of_the_simulated_asset():
    truth = read_whole_truth(open_folder(made()))
    assert truth.surface.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-3)
    assert len(truth.T_board_cam) == 10


def test_a_capture_without_truth_has_none(tmp_path):
    folder = dataclasses.replace(open_folder(made()), path=tmp_path)
    assert read_whole_truth(folder) is None


def test_a_file_that_is_no_mesh_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="is not there"):
        read_mesh_file(tmp_path / "none.ply")
    (tmp_path / "bad.ply").write_bytes(b"nonsense")
    with pytest.raises(CaptureError, match="no mesh that can be read"):
        read_mesh_file(tmp_path / "bad.ply")
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    mesh = read_mesh_file(tmp_path / "box.stl")
    assert isinstance(mesh, Mesh) and len(mesh.faces) == 12
