import numpy as np
import pytest

from tests.workers.capture.photographs import hand_held
from tests.workers.capture.poses.scenes import errors, evidence_of, observe
from workers.capture.poses.estimates import estimate_markers


def estimate(views):
    return estimate_markers(evidence_of(views))


def test_every_view_is_there_with_its_pose_and_residual():
    rng = np.random.default_rng(0)
    truth = hand_held(rng, 6)
    found = estimate([observe(T, rng, number=n + 3) for n, T in enumerate(truth)])
    assert [view.number for view in found.views] == [3, 4, 5, 6, 7, 8]
    for view, T in zip(found.views, truth, strict=True):
        assert view.status == "used" and view.reasons == () and errors(view.T_board_cam, T)[0] < 1.5
        assert view.reprojection_px == pytest.approx(0.2 * np.sqrt(2 * np.log(2)), rel=0.2)  # median of a Rayleigh law
        assert view.depth_mm is None and view.covariance.shape == (6, 6)


def test_an_ambiguous_view_and_one_without_markers_say_so():
    rng = np.random.default_rng(1)
    truth = hand_held(rng, 5, distance_m=(3.0, 3.0), inclination_rad=(1.2, 1.4))
    views = [observe(truth[0], rng, ids=[17]), observe(truth[1], rng, ids=[]), *[observe(T, rng) for T in truth[2:]]]
    found = estimate(views)
    assert found.views[0].status == "flagged"
    assert any("ambiguous" in reason for reason in found.views[0].reasons)
    assert found.views[1].status == "refused" and found.views[1].T_board_cam is None
    assert found.views[1].reasons == ("no markers of the board found, and min_markers is 1",)
