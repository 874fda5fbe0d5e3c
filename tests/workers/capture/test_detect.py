import time

import cv2
import numpy as np
import pytest

from schemas.job.captures import Board
from tests.workers.capture.photographs import HALF, KINECT, hand_held, photograph, printed, true_corners
from workers.capture.board.detect import detect_markers, other_dictionaries
from workers.capture.board.layout import marker_corners, open_dictionary

BOARD = Board()
DICTIONARY = open_dictionary(BOARD)


def errors_px(found, T, k):
    return found.corners_px.reshape(-1, 2) - true_corners(marker_corners(BOARD)[found.ids].reshape(-1, 3), T, k)


def test_corners_lie_where_a_homography_puts_them():
    rng = np.random.default_rng(3)
    errors = []
    for T in hand_held(rng, 4):
        found = detect_markers(photograph(BOARD, T, KINECT, rng), BOARD, DICTIONARY)
        assert len(found.ids) >= 33 and found.dropped == ()
        errors.append(errors_px(found, T, KINECT))
    errors = np.concatenate(errors)
    assert np.sqrt((errors**2).mean()) < 0.07  # pixels an axis; OpenCV's cornerSubPix leaves 0.44 here
    assert np.abs(errors.mean(axis=0)).max() < 0.01  # half a pixel of convention would show


def test_detection_takes_a_quarter_of_a_second_at_most():
    rng = np.random.default_rng(4)
    picture = photograph(BOARD, hand_held(rng, 1)[0], KINECT, rng)
    begun = time.process_time()
    detect_markers(picture, BOARD, DICTIONARY)
    assert time.process_time() - begun < 0.25


def test_a_marker_that_is_seen_twice_is_dropped():
    rng = np.random.default_rng(5)
    print_ = printed(BOARD)
    marker, first, second = 240, (120, 80), (120 + 320, 80)  # pixels of the print: markers 0 and 1
    print_[second[1] : second[1] + marker, second[0] : second[0] + marker] = print_[
        first[1] : first[1] + marker, first[0] : first[0] + marker
    ]
    T = hand_held(rng, 1)[0]
    found = detect_markers(photograph(BOARD, T, KINECT, rng, picture=print_), BOARD, DICTIONARY)
    assert 0 not in found.ids and 1 not in found.ids
    assert found.dropped == ("marker 0 was seen 2 times",)


def test_ids_that_are_not_on_the_board_are_dropped():
    rng = np.random.default_rng(6)
    T = hand_held(rng, 1)[0]
    smaller = Board(columns=7, rows=5, first_id=3)
    found = detect_markers(photograph(BOARD, T, KINECT, rng), smaller, open_dictionary(smaller))
    assert found.ids.min() == 3
    assert set(found.dropped) == {f"marker {n} is not on the board (3 to 37)" for n in (0, 1, 2)}


def test_nothing_is_found_in_a_grey_picture():
    found = detect_markers(np.full((540, 960, 3), 120, np.uint8), BOARD, DICTIONARY)
    assert found.ids.shape == (0,) and found.corners_px.shape == (0, 4, 2)


@pytest.mark.parametrize(("change", "words"), [("dictionary", "DICT_6X6"), ("mirror", "mirrored")])
def test_the_markers_that_a_picture_holds_instead_are_named(change, words):
    rng = np.random.default_rng(7)
    board = Board(dictionary="DICT_6X6_100") if change == "dictionary" else BOARD
    picture = photograph(board, hand_held(rng, 1)[0], HALF, rng)
    if change == "mirror":
        picture = np.ascontiguousarray(cv2.flip(picture, 1))
    assert words in other_dictionaries(picture)
