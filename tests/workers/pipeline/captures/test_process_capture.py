"""The whole chain on a small virtual capture, through the functions that a job uses."""

from pathlib import Path

import numpy as np
import pytest

from schemas.capture import DepthCorrection
from schemas.job.assets import ProceduralSource
from schemas.job.captures import Board, Captures, Estimation, KinectDepthNoise, Simulate
from workers.assets.builtin.make import make_asset
from workers.capture.folder import open_folder, read_truth, write_pose
from workers.capture.make_capture import is_corrected, process_capture
from workers.capture.simulate.simulate import simulate_capture
from workers.geometry.frames import translation
from workers.scene.context import Stopwatch
from workers.scene.plan import SceneChance

CAPTURES = Captures(
    simulate=Simulate(views=6, image_scale=0.3, depth_noise=KinectDepthNoise()),
    estimation=Estimation(estimate="joint", compare=True),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("capture") / "box"
    asset = make_asset("box", ProceduralSource(source="procedural", size="metric"), 1, 1000.0)
    simulate_capture(CAPTURES.simulate, Board(), asset, SceneChance(3, 0), path)
    return path


def test_a_capture_is_processed_without_a_file_more_or_less_in_its_folder(folder):
    before = sorted(folder.rglob("*"))
    watch = Stopwatch()
    done = process_capture(open_folder(folder), CAPTURES, watch)
    assert sorted(folder.rglob("*")) == before
    assert set(done.estimates.by_name) == {"markers", "article", "joint"}
    assert {"estimate", "fuse", "score"} <= set(watch.seconds)
    truth = read_truth(folder)
    for view in done.estimates.estimate.used:
        assert np.linalg.norm(view.T_board_cam[:3, 3] - truth.T_board_cam[view.number][:3, 3]) < 0.003
    assert done.score.cloud_median_mm < 3.0
    assert set(done.score.views) == {view.number for view in done.estimates.estimate.used}
    number = done.estimates.estimate.used[0].number
    seen = done.images(number)
    assert seen.rgb.shape[:2] == seen.depth_m.shape == seen.mask.shape
    assert seen.mask.any()


def test_a_capture_without_truth_has_no_score_and_a_manual_correction_is_its_pose(folder, tmp_path):
    for file in folder.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    known = read_truth(folder).T_board_cam[2]
    write_pose(tmp_path / "board_00002.txt", known)
    write_pose(tmp_path / "correction_00002.txt", translation(0.001, 0.0, 0.0))
    captures = CAPTURES.model_copy(update={"estimation": Estimation(estimate="markers", compare=False)})
    done = process_capture(open_folder(tmp_path), captures, Stopwatch())
    assert done.score is None
    (view,) = [view for view in done.estimates.estimate.views if view.number == 2]
    np.testing.assert_allclose(view.T_board_cam, translation(0.001, 0.0, 0.0) @ known, atol=1e-9)
    assert any("manual" in note for note in done.estimates.estimate.notes)


@pytest.mark.parametrize(
    ("depth", "corrected"),
    [
        (DepthCorrection(), False),
        (DepthCorrection(offset_m=0.001), True),
        (DepthCorrection(scale=1.01), True),
        (DepthCorrection(T_cam_depth=translation(0.0, 0.01, 0.0)), True),
    ],
)
def test_depth_counts_as_corrected_where_the_estimate_changes_it(depth, corrected):
    assert is_corrected(depth) is corrected
