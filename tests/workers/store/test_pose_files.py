import numpy as np

from workers.geometry.frames import pose, rotation_about
from workers.store.capture_folder import pose_text, write_pose
from workers.store.capture_results import write_results
from workers.store.pose_files import read_given_pose

A = pose(rotation_about(np.array([0.0, 0.6, 0.8]), 0.3), np.array([0.1, 0.2, 0.3]))
B = pose(np.eye(3), np.array([0.001, 0, 0]))


def write_own(path):
    write_results(path, {"board_00000.txt": pose_text(A).encode(), "correction_00000.txt": pose_text(B).encode()}, {})


def test_files_of_our_own_are_not_taken_for_others(tmp_path):
    write_own(tmp_path)
    given = read_given_pose(tmp_path, 0)
    assert given.board is None and given.correction is None


def test_a_file_that_somebody_changed_is_theirs_and_stays(tmp_path):
    write_own(tmp_path)
    write_pose(tmp_path / "correction_00000.txt", A)
    write_own(tmp_path)
    given = read_given_pose(tmp_path, 0)
    assert np.array_equal(given.correction, A) and given.board is None


def test_a_file_that_was_there_before_is_given(tmp_path):
    write_pose(tmp_path / "board_00002.txt", A)
    assert np.array_equal(read_given_pose(tmp_path, 2).board, A)
    assert read_given_pose(tmp_path, 3).board is None
