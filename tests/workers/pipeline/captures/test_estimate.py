import numpy as np
import pytest

from schemas.errors import CaptureError
from schemas.job.captures import Board, Estimation
from tests.workers.capture.poses.scenes import errors
from tests.workers.pipeline.captures.folders import write_capture
from workers.pipeline.captures.estimate import estimate_poses
from workers.store.capture_folder import open_folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "box"
    return path, write_capture(path)


def test_poses_of_a_drawn_capture_are_the_true_ones(capture):
    path, truth = capture
    estimates = estimate_poses(open_folder(path), Estimation())
    assert set(estimates.by_name) == {"markers", "article", "joint"}
    for view, T in zip(estimates.by_name["markers"].views, truth, strict=True):
        mm, degrees = errors(view.T_board_cam, T)
        assert view.status == "used" and mm < 0.5 and degrees < 0.05
    assert [found.number for found in estimates.detections] == list(range(len(truth)))


def test_an_estimate_is_the_same_bytes_twice(capture):
    folder = open_folder(capture[0])
    first, second = (estimate_poses(folder, Estimation()) for _ in range(2))
    for name, estimate in first.by_name.items():
        for a, b in zip(estimate.views, second.by_name[name].views, strict=True):
            assert np.array_equal(a.T_board_cam, b.T_board_cam)


def test_only_the_chosen_estimate_is_made_without_comparison(capture):
    estimates = estimate_poses(open_folder(capture[0]), Estimation(estimate="markers", compare=False))
    assert list(estimates.by_name) == ["markers"] and estimates.estimate.estimate == "markers"
    assert set(estimates.seconds) == {"read", "detect", "sample"}


def test_a_capture_of_another_dictionary_is_refused_and_the_right_one_is_named(tmp_path):
    write_capture(tmp_path / "c", 2, board=Board(dictionary="DICT_5X5_50"), box=False)
    text = (tmp_path / "c" / "board.json").read_text().replace("DICT_5X5_50", "DICT_4X4_50")
    (tmp_path / "c" / "board.json").write_text(text)
    with pytest.raises(
        CaptureError, match=r"no marker of DICT_4X4_50 .* the image holds 35 markers of DICT_5X5_50: correct"
    ):
        estimate_poses(open_folder(tmp_path / "c"), Estimation())
