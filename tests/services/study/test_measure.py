"""How things settle with each setting, what a scene costs, and a setting's errors over its scenes."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from schemas.job.job import Job
from services.study.measure import (
    apart,
    figure_over_scenes,
    image_figures,
    job_cost,
    measure_settling,
    settling_figures,
    share,
    slopes,
    timed_rows,
)
from services.study.model import Row, Setting
from workers.assets.catalogue import open_catalogue
from workers.scene.context import WorkerContext

# ---------------------------------------------------------------------------------------------- settling


def setting(name: str, **changes: object) -> Setting:
    return Setting(((name, "x"),), {f"physics.{key}": value for key, value in changes.items()})


COARSE = setting("coarse", step_hz=60, max_step_travel_mm=1.0, solver_iterations=5, exact_rest=False)


@cache
def answers(scene_id: int, **start: object) -> dict[str, dict]:
    job = Job.model_validate({"name": "t", "seed": 2024, "start": start})
    context = WorkerContext(job, open_catalogue(job.assets, Path(), tuple(job.categories)), None, "")  # type: ignore[arg-type]  # draws nothing
    settings = [Setting(), COARSE, setting("box", collision="box")]
    return measure_settling(context, settings, scene_id, posed=True, released=True)


@pytest.mark.minute
def test_every_setting_settles_in_the_same_scene_against_a_reference_that_finer_steps_confirm():
    """Bullet leaves what rests some micrometres deep; exact rest takes that away."""
    found = [answers(scene_id, pose="upright") for scene_id in range(3)]
    for one in found:
        assert set(one) == {"reference", "the job", "coarse=x", "box=x"}
        assert one["the job"]["penetration_mm"] < 1e-9 and one["the job"]["gap_mm"] < 1e-9
        assert one["the job"]["moved_mm"] < 0.05
        assert ("pose_mm" in one["the job"]) == bool(one["reference"]["agreed"])
    assert max(one["coarse=x"].get("penetration_mm", 0.0) for one in found) > 1e-4
    assert sum(bool(one["reference"]["agreed"]) for one in found) >= 2


@pytest.mark.minute
def test_a_box_about_a_tumbled_object_comes_to_rest_elsewhere_than_its_hull():
    """Let go upright both stand on the same base."""
    far, own = (
        [answers(scene, pose="tumbled")[name].get("pose_mm", 0.0) for scene in range(3)]
        for name in ("box=x", "the job")
    )
    assert max(far) > 10 * max(own) > 0.0


def test_a_scene_that_cannot_be_drawn_has_no_answers():
    assert answers(0, offset_m=(50.0, 60.0)) == {}


def test_errors_of_smooth_cases_fall_with_the_step_in_the_order_of_the_integrator():
    found = slopes()
    assert found["free fall"] == pytest.approx(1.0, abs=1e-3)
    assert found["sliding to rest"] == pytest.approx(1.0, abs=0.05)


# ---------------------------------------------------------------------------------------------- costs

OWN, FLAT, STEP = Setting(), Setting((("tier", "flat"),)), Setting((("step", "60"),))


def lap(new: float = 1.2, slow: float = 1.0) -> dict[int, dict]:
    """Two scenes of 100 and 300 ms, `new` times as long with new shapes; by `slow` the whole scenes of a slower round."""
    return {
        scene: {
            "cold": new * base,
            "whole": {OWN.name: slow * base, FLAT.name: slow * 0.5 * base},
            "settling": {OWN.name: 0.02, STEP.name: 0.01},
            "bytes": {OWN.name: 1000, FLAT.name: 400},
        }
        for scene, base in ((0, 0.1), (1, 0.3))
    }


def rows_of(*laps: dict[int, dict]) -> dict[str, Row]:
    never = Setting((("step", "1"),))
    return {row.setting.name: row for row, scenes in timed_rows((OWN, FLAT, STEP, never), laps) if scenes <= 2}


def test_ratios_count_new_shapes_in_both_and_what_only_settles_is_added_to_the_whole():
    assert job_cost([lap()], OWN.name) == pytest.approx((240.0, 1.0))
    found = rows_of(lap())
    assert list(found) == [OWN.name, FLAT.name, STEP.name]
    own, flat, step = found.values()
    assert (own.ms, own.ratio, own.errors, own.failed_share) == (pytest.approx(240.0), 1.0, {}, 0.0)
    assert flat.ratio == flat.ratio_least == flat.ratio_most == pytest.approx((0.48 - 0.2) / 0.48)
    assert flat.ms == pytest.approx(240.0 * flat.ratio) and flat.kilobytes == 0.4
    assert step.ratio == pytest.approx((0.48 - 0.02) / 0.48) and step.kilobytes == own.kilobytes == 1.0


def test_a_slower_round_changes_no_ratio_and_scenes_that_a_setting_cannot_make_count_in_neither():
    flat = rows_of(lap(new=1.0), lap(new=1.0, slow=3.0))[FLAT.name]
    assert (flat.ratio_least, flat.ratio_most) == pytest.approx((0.5, 0.5))
    missing = lap()
    del missing[1]["whole"][FLAT.name]
    assert [scenes for _, scenes in timed_rows((OWN, FLAT), [missing])] == [2, 1]
    assert rows_of(missing)[FLAT.name].ratio == pytest.approx((0.12 - 0.05) / 0.12)


# ---------------------------------------------------------------------------------------------- over scenes


def test_an_error_is_the_95th_percentile_of_the_scenes_and_lies_in_its_interval():
    figure = figure_over_scenes([float(k) for k in range(101)])
    assert (figure.value, figure.median, figure.scenes) == (95.0, 50.0, 101)
    assert 85.0 < figure.low < 95.0 < figure.high <= 100.0
    found = image_figures([{"depth_mm": 1.0}, {"depth_mm": 3.0, "mirror_mm": 5.0}])
    assert list(found) == ["depth_mm", "mirror_mm"]
    assert found["depth_mm"].median == 2.0 and found["mirror_mm"].scenes == 1


def test_the_distance_of_two_distributions_is_their_shift():
    """Of samples that are shifted the first Wasserstein distance is the shift, and their order does not matter."""
    rng = np.random.default_rng(1)
    sample = rng.normal(size=300)
    found = apart(sample + 0.7, sample)
    assert found.value == pytest.approx(0.7, abs=1e-12)
    assert found.low <= 0.7 + 1e-12 and found.high >= 0.7 - 1e-12
    assert apart(sample, rng.permutation(sample)).value == pytest.approx(0.0, abs=1e-12)


def test_the_interval_of_a_share_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(2)
    figures = [share(list(rng.random(200) < 0.3)) for _ in range(100)]
    assert 88 <= sum(figure.low <= 0.3 <= figure.high for figure in figures) <= 100


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
    assert (found["outcome_deg"].value, found["failed_share"].value) == (0.0, 0.25)
    assert found["pose_mm"].scenes == 1 and "moved_mm" not in found
    assert settling_figures("step=120", scenes) == {}
