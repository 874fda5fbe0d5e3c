"""Slips of paper over markers, against shapely."""

import numpy as np
import pytest
from shapely import Polygon

from schemas.job.captures import Board, HiddenMarkers
from workers.capture.board.layout import marker_corners
from workers.capture.simulate.camera import HEIGHT_M, cover_markers

MARKERS = [Polygon(corners[:, :2]) for corners in marker_corners(Board())]


def slips_of(share, seed):
    part = cover_markers(HiddenMarkers(share=share), Board(), np.random.default_rng(seed)).parts[0]
    assert (part.vertices[:, 2] == HEIGHT_M).all()
    return part, [Polygon(slip[:, :2]) for slip in part.vertices.reshape(-1, 4, 3)]


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_each_slip_hides_a_part_of_its_marker(share):
    for seed in range(10):
        _, slips = slips_of(share, seed)
        assert len(slips) == round(35 * share)
        covered = np.array([[s.intersection(m).area / m.area for m in MARKERS] for s in slips])
        assert (covered.max(axis=1) > 0.03).all()
        assert (covered.max(axis=1) < 0.75).all()
        assert len(set(covered.argmax(axis=1))) >= 0.9 * len(slips)


def test_faces_look_up():
    part, slips = slips_of(0.4, 3)
    a, b, c = (part.vertices[part.faces[:, n]] for n in range(3))
    up = np.cross(b - a, c - a)[:, 2]
    assert (up > 0.0).all()
    assert 0.5 * up.sum() == pytest.approx(sum(s.area for s in slips))


def test_no_share_is_no_slip():
    assert cover_markers(HiddenMarkers(share=0.0), Board(), np.random.default_rng(1)) is None
