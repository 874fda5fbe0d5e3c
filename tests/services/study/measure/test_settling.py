"""How things settle with each setting: a reference of its own, errors that grow where they must."""

from functools import cache
from pathlib import Path

import pytest

from schemas.job.job import Job
from services.study.knobs import apply, knobs_of
from services.study.measure import REFERENCES, measure_settling
from services.study.model import Setting
from workers.assets.catalogue import open_catalogue
from workers.scene.context import WorkerContext


def setting(name: str, **changes: object) -> Setting:
    return Setting(((name, "x"),), {f"physics.{key}": value for key, value in changes.items()})


COARSE = setting("coarse", step_hz=60, max_step_travel_mm=1.0, solver_iterations=5, exact_rest=False)
BOX = setting("box", collision="box")


@cache
def answers(scene_id: int, start: str = "upright") -> dict[str, dict]:
    job = Job.model_validate({"name": "t", "seed": 2024, "start": {"pose": start}})
    catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
    context = WorkerContext(job, catalogue, None, "")  # type: ignore[arg-type]  # nothing is drawn
    return measure_settling(context, [Setting(), COARSE, BOX], scene_id, posed=True, released=True)


def test_the_reference_is_finer_than_anything_that_a_knob_can_be():
    values = [v.changes for knob in knobs_of(Job(name="t")) if knob.group == "physics" for v in knob.values]
    for reference in REFERENCES:
        assert all(v.get("physics.step_hz", 0) < reference["step_hz"] for v in values)
        assert all(v.get("physics.max_step_travel_mm", 1.0) >= reference["max_step_travel_mm"] for v in values)
        assert all(v.get("physics.solver_iterations", 0) < reference["solver_iterations"] for v in values)


@pytest.mark.parametrize("scene_id", [0, 1, 2])
def test_every_setting_is_measured_in_the_same_scene(scene_id):
    found = answers(scene_id)
    assert set(found) == {"reference", "the job", "coarse=x", "box=x"}
    assert found["the job"]["penetration_mm"] < 1e-9 and found["the job"]["gap_mm"] < 1e-9
    assert found["the job"]["moved_mm"] < 0.05


def test_coarse_steps_without_exact_rest_leave_things_in_the_table():
    """Bullet leaves what rests some micrometres deep; exact rest takes that away."""
    assert max(answers(scene)["coarse=x"].get("penetration_mm", 0.0) for scene in (0, 1, 2)) > 1e-4


def test_a_pose_has_an_error_only_where_two_finer_settings_agree():
    for scene in (0, 1, 2):
        found = answers(scene)
        assert ("pose_mm" in found["the job"]) == bool(found["reference"]["agreed"])
    assert sum(bool(answers(scene)["reference"]["agreed"]) for scene in (0, 1, 2)) >= 2


def test_a_box_about_a_tumbled_object_comes_to_rest_elsewhere_than_its_hull():
    """Let go upright both stand on the same base."""
    far = [answers(scene, "tumbled")["box=x"].get("pose_mm", 0.0) for scene in (0, 1, 2)]
    own = [answers(scene, "tumbled")["the job"].get("pose_mm", 0.0) for scene in (0, 1, 2)]
    assert max(far) > 10 * max(own) > 0.0


def test_a_scene_that_cannot_be_drawn_has_no_answers():
    job = apply(Job(name="t"), {"start.offset_m": [50.0, 60.0]})
    catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
    context = WorkerContext(job, catalogue, None, "")
    assert measure_settling(context, [Setting()], 0, posed=False, released=False) == {}
