import numpy as np
import pytest

from schemas.errors import CaptureError
from workers.geometry.frames import pose, rotation_about
from workers.store.capture_folder import read_pose, write_pose
from workers.store.pose_files import OWN_FILE, read_given_pose, write_pose_files

A = pose(rotation_about(np.array([0.0, 0.6, 0.8]), 0.3), np.array([0.1, 0.2, 0.3]))
B = pose(np.eye(3), np.array([0.001, 0, 0]))


def test_files_of_our_own_are_not_taken_for_others(tmp_path):
    write_pose_files(tmp_path, {0: A, 1: A}, {0: B})
    assert np.array_equal(read_pose(tmp_path / "board_00000.txt"), A)
    assert np.array_equal(read_pose(tmp_path / "correction_00000.txt"), B)
    given = read_given_pose(tmp_path, 0)
    assert given.board is None and given.correction is None


def test_a_file_that_somebody_changed_is_theirs_and_stays(tmp_path):
    write_pose_files(tmp_path, {0: A}, {0: B})
    write_pose(tmp_path / "correction_00000.txt", A)
    write_pose_files(tmp_path, {0: B}, {0: B})
    given = read_given_pose(tmp_path, 0)
    assert np.array_equal(given.correction, A) and given.board is None
    assert np.array_equal(read_pose(tmp_path / "board_00000.txt"), B)


def test_a_file_that_was_there_before_is_given(tmp_path):
    write_pose(tmp_path / "board_00002.txt", A)
    assert np.array_equal(read_given_pose(tmp_path, 2).board, A)
    assert read_given_pose(tmp_path, 3).board is None


@pytest.mark.parametrize("text", ["[", "[1]", '{"a": 1}'])
def test_a_spoilt_table_of_our_files_is_named(tmp_path, text):
    (tmp_path / OWN_FILE).write_text(text)
    with pytest.raises(CaptureError, match=r"poses\.json"):
        read_given_pose(tmp_path, 0)


def test_the_same_poses_are_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_pose_files(tmp_path / name, {1: A, 0: B}, {1: B})
    assert {f.name: f.read_bytes() for f in (tmp_path / "a").iterdir()} == {
        f.name: f.read_bytes() for f in (tmp_path / "b").iterdir()
    }
