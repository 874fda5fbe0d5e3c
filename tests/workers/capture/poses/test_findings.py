import dataclasses
import re

from schemas.job.captures import Board, Estimation
from tests.workers.capture.poses.captures import CORNER_PX, Virtual, make, replaced, without_depth
from workers.capture.poses.estimates import estimate_joint

SMALL = Virtual(views=6)
_, EVIDENCE = make(SMALL)
_, LARGER = make(replaced(SMALL, print_scale=1.02))


def notes(evidence, **spec):
    setup = dataclasses.replace(evidence.setup, spec=Estimation(corner_px=CORNER_PX, **spec))
    return " | ".join(estimate_joint(dataclasses.replace(evidence, setup=setup)).notes)


def test_a_print_of_another_size_is_said_to_be_undecidable_and_the_ruler_asked_for():
    said = notes(LARGER)
    told = re.search(r"by depth the print is (\d\.\d) % larger", said)
    assert told and abs(float(told[1]) - 2.0) < 0.31
    assert "cannot be identified" in said and "measured_ruler_m" in said and "the print was believed" in said
    assert "depth was believed" in notes(LARGER, trust="depth")


def test_a_ruler_that_was_measured_is_not_asked_for_again():
    board = Board(measured_ruler_m=0.2)
    measured = dataclasses.replace(LARGER, setup=dataclasses.replace(LARGER.setup, board=board))
    said = " | ".join(estimate_joint(measured).notes)
    assert "although its ruler was measured" in said and "Measure the printed ruler" not in said


def test_scales_that_agree_are_not_mentioned():
    assert "disagree" not in notes(EVIDENCE)


def test_the_sigmas_are_told():
    said = notes(EVIDENCE)
    assert "sigma of a corner: 0.05" in said or "sigma of a corner: 0.04" in said
    assert "depth of the board: sigma of a patch 0." in said and "of all patches of a view together 0." in said


def test_a_capture_without_depth_says_so():
    assert "no depth" in notes(without_depth(EVIDENCE))
