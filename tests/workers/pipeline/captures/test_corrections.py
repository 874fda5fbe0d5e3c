"""Manual corrections win over every estimate, and our own files are no corrections."""

import dataclasses

import numpy as np
import pytest

from schemas.errors import CaptureError
from tests.workers.pipeline.captures.small_capture import copy_of, made, processed, true_estimates
from workers.capture.folder import open_folder, pose_text, read_pose, write_pose
from workers.capture.reconstruct import MANUAL, Given, correct_manually, corrections_of, given_files
from workers.capture.results import write_results
from workers.geometry.frames import invert, pose, rotation_about, translation

A = pose(rotation_about(np.array([0.0, 0.6, 0.8]), 0.3), np.array([0.1, 0.2, 0.3]))
B = pose(np.eye(3), np.array([0.001, 0, 0]))


def given_in(path) -> Given:
    """What the user gave in a folder that has poses alone."""
    return given_files(dataclasses.replace(open_folder(made()), path=path))


def write_own(path):
    write_results(path, {"board_00000.txt": pose_text(A).encode(), "correction_00000.txt": pose_text(B).encode()}, {})


def test_files_of_our_own_are_not_taken_for_others(tmp_path):
    write_own(tmp_path)
    given = given_in(tmp_path)
    assert given.pose("board", 0) is None and given.pose("correction", 0) is None


def test_a_file_that_somebody_changed_is_theirs_and_stays(tmp_path):
    write_own(tmp_path)
    write_pose(tmp_path / "correction_00000.txt", A)
    write_own(tmp_path)
    given = given_in(tmp_path)
    assert np.array_equal(given.pose("correction", 0), A) and given.pose("board", 0) is None


def test_a_file_that_was_there_before_is_given(tmp_path):
    write_pose(tmp_path / "board_00002.txt", A)
    assert np.array_equal(given_in(tmp_path).pose("board", 2), A)
    assert given_in(tmp_path).pose("board", 3) is None


def test_without_files_of_the_user_estimates_stay():
    folder, estimates = open_folder(made()), true_estimates(made())
    assert correct_manually(given_files(folder), estimates) is estimates


def test_a_manual_correction_moves_the_pose_of_the_markers(tmp_path):
    path = copy_of(made(), tmp_path)
    estimates = true_estimates(path)
    write_pose(path / "correction_00002.txt", translation(0.01, 0.02, 0.03))
    moved = correct_manually(given_files(open_folder(path)), estimates).estimate
    before = estimates.estimate.views[2].T_board_cam
    assert np.allclose(moved.views[2].T_board_cam[:3, 3] - before[:3, 3], [0.01, 0.02, 0.03])
    assert MANUAL in moved.views[2].reasons and moved.notes == ("1 pose from manual corrections",)
    assert moved.views[3] is estimates.estimate.views[3]


def test_a_manual_board_pose_is_what_the_correction_corrects(tmp_path):
    path = copy_of(made(), tmp_path)
    T = true_estimates(path).estimate.views[0].T_board_cam
    write_pose(path / "board_00004.txt", T)
    write_pose(path / "correction_00004.txt", np.eye(4))
    estimates = correct_manually(given_files(open_folder(path)), true_estimates(path, without=(4,)))
    assert np.allclose(estimates.estimate.views[4].T_board_cam, T)
    assert estimates.estimate.views[4].status == "used"


def test_a_correction_of_no_pose_is_refused(tmp_path):
    path = copy_of(made(), tmp_path)
    write_pose(path / "correction_00004.txt", np.eye(4))
    with pytest.raises(CaptureError, match=r"correction_00004\.txt corrects a pose that is not known"):
        correct_manually(given_files(open_folder(path)), true_estimates(path, without=(4,)))


def test_our_own_files_are_not_the_users(tmp_path):
    path = copy_of(processed()[0], tmp_path)
    folder, estimates = open_folder(path), true_estimates(path)
    assert correct_manually(given_files(folder), estimates) is estimates
    assert not given_files(folder).has_mask(0)
    write_pose(path / "correction_00001.txt", translation(0.0, 0.0, 0.001) @ read_pose(path / "correction_00001.txt"))
    changed = correct_manually(given_files(folder), estimates).estimate
    assert MANUAL in changed.views[1].reasons


def test_corrections_lead_from_the_board_pose_to_the_final_one():
    folder, estimates = open_folder(made()), true_estimates(made())
    for number, (board, correction) in corrections_of(given_files(folder), estimates).items():
        assert np.allclose(correction @ board, estimates.estimate.views[number].T_board_cam)
        assert np.allclose(correction @ invert(correction), np.eye(4))
