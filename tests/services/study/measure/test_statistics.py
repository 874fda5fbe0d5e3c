"""Figures of errors: the percentile, the distance of distributions, and intervals that cover."""

import numpy as np
import pytest

from services.study.measure import apart, figure_over_scenes, image_figures, settling_figures, share


def test_an_error_is_the_95th_percentile_of_the_scenes_and_lies_in_its_interval():
    figure = figure_over_scenes([float(k) for k in range(101)])
    assert (figure.value, figure.median, figure.scenes) == (95.0, 50.0, 101)
    assert 85.0 < figure.low < 95.0 < figure.high <= 100.0


def test_of_no_scenes_there_is_no_error():
    with pytest.raises(ValueError, match="no scenes"):
        figure_over_scenes([])


def test_the_distance_of_two_distributions_is_their_shift():
    """Of samples that are shifted the first Wasserstein distance is the shift, and their order does not matter."""
    rng = np.random.default_rng(1)
    sample = rng.normal(size=300)
    assert apart(sample + 0.7, sample).value == pytest.approx(0.7, abs=1e-12)
    assert apart(sample, rng.permutation(sample)).value == pytest.approx(0.0, abs=1e-12)
    found = apart(sample + 0.7, sample)
    assert found.low <= 0.7 + 1e-12 and found.high >= 0.7 - 1e-12


def test_the_interval_of_a_share_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(100):
        figure = share(list(rng.random(200) < 0.3))
        inside += figure.low <= 0.3 <= figure.high
    assert 88 <= inside <= 100


def test_settling_is_held_against_the_reference_of_the_same_scenes():
    def one(slid: float, **more: object) -> dict[str, object]:
        return {"failed": False, "penetration_mm": 0.1, "gap_mm": 0.0, "slid_mm": slid, "rolled_deg": 1.0, **more}

    scenes = [
        {"reference": one(1.0), "step=60": one(3.0, pose_mm=2.0)},
        {"reference": one(2.0), "step=60": one(4.0)},
        {"reference": {"failed": True}, "step=60": one(100.0)},
        {"reference": one(5.0), "step=60": {"failed": True}},
        {},
    ]
    found = settling_figures("step=60", scenes)
    assert found["outcome_mm"].value == pytest.approx(2.0) and found["outcome_mm"].scenes == 2
    assert found["outcome_deg"].value == 0.0
    assert found["failed_share"].value == 0.25
    assert found["pose_mm"].scenes == 1 and "moved_mm" not in found
    assert settling_figures("step=120", scenes) == {}


def test_images_have_the_errors_that_any_scene_has():
    found = image_figures([{"depth_mm": 1.0}, {"depth_mm": 3.0, "mirror_mm": 5.0}])
    assert list(found) == ["depth_mm", "mirror_mm"]
    assert found["depth_mm"].median == 2.0 and found["mirror_mm"].scenes == 1
