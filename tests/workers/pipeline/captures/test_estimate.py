import shutil

import cv2
import numpy as np
import pytest

from schemas.errors import CaptureError
from schemas.job.captures import Board, Estimation
from tests.workers.capture.poses.scenes import errors
from tests.workers.pipeline.captures.folders import write_capture
from workers.capture.board.layout import frame_in_board
from workers.capture.estimate import estimate_poses
from workers.capture.folder import open_folder, pose_text, write_pose
from workers.capture.reconstruct import given_files
from workers.capture.results import write_results
from workers.geometry.frames import invert, pose, rotation_about


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "box"
    return path, write_capture(path)


def test_poses_of_a_drawn_capture_are_the_true_ones(capture):
    path, truth = capture
    estimates = estimate_poses(given_files(open_folder(path)), Estimation())
    assert set(estimates.by_name) == {"markers", "article", "joint"}
    for view, T in zip(estimates.by_name["markers"].views, truth, strict=True):
        mm, degrees = errors(view.T_board_cam, T)
        assert view.status == "used" and mm < 0.5 and degrees < 0.05
    assert [found.number for found in estimates.detections] == list(range(len(truth)))


def test_an_estimate_is_the_same_bytes_twice(capture):
    folder = open_folder(capture[0])
    first, second = (estimate_poses(given_files(folder), Estimation()) for _ in range(2))
    for name, estimate in first.by_name.items():
        for a, b in zip(estimate.views, second.by_name[name].views, strict=True):
            assert np.array_equal(a.T_board_cam, b.T_board_cam)


def test_only_the_chosen_estimate_is_made_without_comparison(capture):
    estimates = estimate_poses(given_files(open_folder(capture[0])), Estimation(estimate="markers", compare=False))
    assert list(estimates.by_name) == ["markers"] and estimates.estimate.estimate == "markers"
    assert set(estimates.seconds) == {"read", "detect", "sample"}


def test_a_capture_of_another_dictionary_is_refused_and_the_right_one_is_named(tmp_path):
    write_capture(tmp_path / "c", 2, board=Board(dictionary="DICT_5X5_50"), box=False)
    text = (tmp_path / "c" / "board.json").read_text().replace("DICT_5X5_50", "DICT_4X4_50")
    (tmp_path / "c" / "board.json").write_text(text)
    with pytest.raises(
        CaptureError, match=r"no marker of DICT_4X4_50 .* the image holds 3[0-9] markers of DICT_5X5_50: correct"
    ):
        estimate_poses(given_files(open_folder(tmp_path / "c")), Estimation())


CORRECTION = pose(rotation_about(np.array([0.0, 0, 1]), 0.02), np.array([0.01, 0.0, 0.005]))


@pytest.fixture
def copy(capture, tmp_path):
    path = tmp_path / "copy"
    shutil.copytree(capture[0], path)
    return path


def test_a_manual_correction_makes_the_views_pose(copy):
    before = estimate_poses(given_files(open_folder(copy)), Estimation())
    write_pose(copy / "correction_00002.txt", CORRECTION)
    after = estimate_poses(given_files(open_folder(copy)), Estimation())
    board = before.by_name["markers"].views[2].T_board_cam
    assert np.array_equal(after.by_name["markers"].views[2].T_board_cam, board)
    for name in ("article", "joint"):
        assert after.by_name[name].views[2].T_board_cam == pytest.approx(CORRECTION @ board, abs=1e-12)
    assert "correction_00002.txt is kept as it was given" in after.estimate.views[2].reasons[-1]


@pytest.mark.parametrize("frame", ["centre", "opencv", "opencv_old"])
def test_given_board_poses_are_read_in_the_frame_that_the_flag_names(copy, capture, frame):
    text = (copy / "capture.json").read_text().replace('"frame":"centre"', f'"frame":"{frame}"')
    (copy / "capture.json").write_text(text.replace('"frame": "centre"', f'"frame": "{frame}"'))
    theirs = invert(frame_in_board(Board(), frame)) @ capture[1][1]
    write_pose(copy / "board_00001.txt", theirs)
    write_pose(copy / "correction_00001.txt", CORRECTION)
    found = estimate_poses(given_files(open_folder(copy)), Estimation()).estimate.views[1].T_board_cam
    assert found == pytest.approx(frame_in_board(Board(), frame) @ CORRECTION @ theirs, abs=1e-9)


def test_our_own_corrections_of_an_earlier_run_change_nothing(copy):
    before = estimate_poses(given_files(open_folder(copy)), Estimation())
    own = {"board_00000.txt": np.eye(4), "correction_00000.txt": CORRECTION, "correction_00002.txt": CORRECTION}
    write_results(copy, {name: pose_text(T).encode() for name, T in own.items()}, {})
    after = estimate_poses(given_files(open_folder(copy)), Estimation())
    for a, b in zip(before.estimate.views, after.estimate.views, strict=True):
        assert np.array_equal(a.T_board_cam, b.T_board_cam)


def test_a_board_pose_that_was_given_serves_where_no_marker_is_seen(copy, capture):
    cv2.imwrite(str(copy / "rgb_00003.png"), np.full((540, 960, 3), 120, np.uint8))
    write_pose(copy / "board_00003.txt", capture[1][3])
    view = estimate_poses(given_files(open_folder(copy)), Estimation()).estimate.views[3]
    assert view.status == "used" and view.T_board_cam == pytest.approx(capture[1][3], abs=1e-12)
    (copy / "board_00003.txt").unlink()
    write_pose(copy / "correction_00003.txt", CORRECTION)
    with pytest.raises(CaptureError, match="corrects nothing"):
        estimate_poses(given_files(open_folder(copy)), Estimation())
