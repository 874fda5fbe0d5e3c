"""How one scene comes to rest with each setting and what it costs, and what breaks a measure is counted."""

from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import SettleError
from schemas.job.job import Job
from services.study import measure
from services.study.measure import QUICK_S, answer_for, measure_rest, own_rest
from services.study.model import REFERENCES, Setting
from services.study.table import pose_error
from workers.assets.catalogue import open_catalogue
from workers.scene.context import WorkerContext
from workers.scene.make_scene import Laid, lay_scene
from workers.stopwatch import Stopwatch


def setting(name: str, **changes: object) -> Setting:
    return Setting(((name, "x"),), {f"physics.{key}": value for key, value in changes.items()})


OWN = Setting()
COARSE = setting("coarse", step_hz=60, max_step_travel_mm=1.0, solver_iterations=5, exact_rest=False)
BOX = setting("box", collision="box")


@cache
def answers(scene_id: int, **start: object) -> dict[str, dict]:
    job = Job.model_validate({"name": "t", "seed": 2024, "start": start})
    context = WorkerContext(job, open_catalogue(job.assets, Path(), tuple(job.categories)), None, "")  # type: ignore[arg-type]  # draws nothing
    settings = [OWN, COARSE, BOX, *REFERENCES]
    measure._seen.clear()  # a process has one study, but for one of tests
    return measure_rest(context, settings, scene_id)


def poses_off(name: str, pose: str) -> list[float]:
    """Of the scenes in which the references agree."""
    scenes = [answers(scene, pose=pose) for scene in range(3)]
    off = [pose_error(one[name], [one[ref.name] for ref in REFERENCES]) for one in scenes]
    return [value for value in off if value is not None]


@pytest.mark.minute
def test_every_setting_settles_in_the_same_scene_against_a_reference_that_finer_steps_confirm():
    """Bullet leaves what rests some micrometres deep; exact rest takes that away."""
    scenes = [answers(scene_id, pose="upright") for scene_id in range(3)]
    for one in scenes:
        own = one["the job"]
        assert own["errors"]["penetration_mm"] < 1e-9 and own["errors"]["gap_mm"] < 1e-9
        assert (own["lost"], own["planned"]) == (0, 1) and "failed" not in own
        assert 0.0 < own["s"] < own["took"] + own["plan_s"] + 1.0 and "plan_s" not in one["box=x"]
    assert max(one["coarse=x"]["errors"]["penetration_mm"] for one in scenes) > 1e-4
    assert len(poses_off("the job", "upright")) >= 2


@pytest.mark.minute
def test_a_box_about_a_tumbled_object_comes_to_rest_elsewhere_than_its_hull():
    """Let go upright both stand on the same base."""
    far, own = poses_off("box=x", "tumbled"), poses_off("the job", "tumbled")
    assert max(far) > 10 * max(own) > 0.0


def test_a_scene_that_cannot_be_drawn_is_a_failed_answer_with_its_reason():
    scenes = answers(0, offset_m=(50.0, 60.0))
    assert {one["failed"] for one in scenes.values()} == {"no_table_below"} and all(
        "errors" not in one for one in scenes.values()
    )


def test_what_breaks_a_measure_is_a_counted_answer(monkeypatch):
    def broken(error: Exception | None) -> dict:
        while error is None:
            pass
        raise error

    monkeypatch.setitem(measure.LIMIT, "s", 0.05)
    scenes = answer_for(partial(broken, None))
    assert scenes["failed"] == "time_out" and 0.03 < scenes["took"] < 20.0
    monkeypatch.setitem(measure.LIMIT, "s", float("inf"))
    tiny = answer_for(lambda: {"errors": {"penetration_mm": 4e-8, "gap_mm": 0.0123456789}})["errors"]
    assert tiny == {"penetration_mm": 0.0, "gap_mm": 0.012346}
    flat, lost = ValueError("initial simplex is flat"), SettleError("left_table", "it is gone")
    flat, lost = (answer_for(partial(broken, error)) for error in (flat, lost))
    assert flat["failed"] == "broken" and "initial simplex is flat" in flat["broken"]
    assert lost["failed"] == "left_table" and "broken" not in lost


@pytest.mark.minute
def test_a_slow_scene_settles_once_for_what_is_measured_and_what_is_drawn(monkeypatch, tmp_path):
    """The job's own scene warms a process up first, whose shapes are no setting's time, of a slow scene either."""
    job = Job.model_validate({"name": "t", "seed": 2024, "start": {"pose": "upright"}})
    made: list[str] = []

    def counted(worker: WorkerContext, scene_id: int, watch: Stopwatch) -> Laid:
        laid = lay_scene(worker, scene_id, watch)
        watch.seconds["physics"] = 1.0 if made else 5.0  # shapes are made once
        made.append("other" if worker.job.physics.collision == "box" else "own")
        return laid

    monkeypatch.setattr(measure, "lay_scene", counted)
    counts = {}
    for quick_s in (1e9, 0.0):
        folder = tmp_path / f"{quick_s:g}"
        folder.mkdir()
        monkeypatch.setitem(QUICK_S, "rest", quick_s)
        monkeypatch.setitem(measure.RESTS, "folder", folder)
        monkeypatch.setattr(measure, "_seen", set())
        monkeypatch.setattr(measure, "_ran", {("rest", "the job"), ("rest", "box=x")})
        processes = [
            WorkerContext(job, open_catalogue(job.assets, Path(), tuple(job.categories)), None, "") for _ in range(2)
        ]
        made.clear()
        first = measure_rest(processes[0], [OWN, BOX], 0)
        assert max(one["s"] for one in first.values()) < 2.0 and first["the job"]["plan_s"] > 3.0
        rest = own_rest(processes[1], 0)
        monkeypatch.setattr(measure, "_seen", set())  # as in another process
        measure_rest(processes[1], [BOX], 0)
        counts[quick_s] = (made.count("own"), made.count("other"), len(list(folder.iterdir())))
        truth = lay_scene(processes[0], 0, Stopwatch()).rest
        assert np.array_equal(rest.settled[0].T_world_obj, truth.settled[0].T_world_obj)
    assert counts == {1e9: (4, 2, 0), 0.0: (3, 2, 1)}
