"""Poses and surface of a capture, and the notes of both."""

import dataclasses

from schemas.job.captures import Captures, Estimation, Fusion
from tests.workers.pipeline.captures.small_capture import copy_of, made, true_estimates
from workers.capture.estimate import ProcessorClock, estimate_surface, with_notes
from workers.capture.folder import open_folder, write_pose
from workers.capture.reconstruct import MANUAL, given_files
from workers.geometry.frames import translation

QUICK = Captures(estimation=Estimation(estimate="markers", compare=False), fusion=Fusion(voxel_m=0.004))


def test_the_chosen_estimate_has_the_users_corrections_and_the_notes_of_the_surface(tmp_path):
    path = copy_of(made(), tmp_path)
    write_pose(path / "correction_00002.txt", translation(0.001, 0.0, 0.0))
    (path / "depth_00003.png").unlink()
    clock = ProcessorClock()
    estimates, merged = estimate_surface(given_files(open_folder(path)), QUICK, clock)
    assert MANUAL in estimates.estimate.views[2].reasons
    assert "1 used views have no depth" in merged.notes
    assert {*merged.notes, "1 pose from manual corrections"} <= set(estimates.estimate.notes)
    assert {"estimate", "read", "fuse"} <= set(clock.seconds)


def test_a_note_is_told_once_and_in_the_chosen_estimate_alone():
    estimates = true_estimates(made())
    noted = dataclasses.replace(estimates.estimate, notes=("a", "b"))
    told = with_notes(dataclasses.replace(estimates, by_name={**estimates.by_name, "joint": noted}), ("b", "c"))
    assert told.estimate.notes == ("a", "b", "c") and told.by_name["markers"].notes == ()
