"""A round: what is measured of which settings in which scenes, and whose poses are compared."""

from pathlib import Path

from schemas.job.job import Job
from services.study.knobs import choose_knobs, knobs_of, settings_of
from services.study.model import Plan, Sizes
from services.study.study import Round

SIZES = Sizes(scenes=3, settled=5, released=1, posed=2, timed=2, laps=2, coloured=1)


def round_of(*knobs: str, times_only: bool = False) -> Round:
    job = Job(name="t", first_scene=100)
    chosen = choose_knobs(knobs_of(job), knobs)
    settings, _ = settings_of(job, chosen)
    return Round(Plan(job, Path(), chosen, settings, (), None, SIZES), "alone", settings, times_only)


def test_times_are_taken_lap_by_lap_with_every_setting():
    part = round_of("step", "units")
    units = part.timings()
    assert [unit.name for unit in units] == [f"alone/time/{lap}/{scene}" for lap in (0, 1) for scene in (100, 101)]
    assert all(unit.settings == part.settings for unit in units)


def test_a_scene_is_measured_only_of_the_parts_that_a_setting_changes():
    units = round_of("step", "units").errors()
    assert [(unit.kind, unit.scene_id) for unit in units] == [
        *(("images", scene) for scene in range(100, 103)),
        *(("settling", scene) for scene in range(100, 105)),
    ]
    for unit in units:
        knob = {"images": "units", "settling": "step"}[unit.kind]
        assert unit.settings[0].name == "the job" and len(unit.settings) > 1
        assert {setting.parts[0][0] for setting in unit.settings[1:]} == {knob}


def test_only_the_first_scenes_are_released_again_and_compared_with_the_truth():
    settling = [unit for unit in round_of("step").errors() if unit.kind == "settling"]
    assert [unit.posed for unit in settling] == [True, True, False, False, False]
    assert [unit.released for unit in settling] == [True, False, False, False, False]


def test_a_round_of_times_alone_measures_no_error():
    assert round_of("step", times_only=True).errors() == [] != round_of("step").errors()
