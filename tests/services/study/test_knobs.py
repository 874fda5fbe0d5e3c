"""Knobs: each value is a job that is allowed, none is the job itself, and what cannot be turned is told."""

import pytest

from schemas.errors import InputError
from schemas.job.job import Job
from services.study import knobs
from services.study.knobs import (
    apply,
    choose_knobs,
    groups_of,
    job_tree_with,
    joined,
    knobs_of,
    settings_of,
)
from services.study.model import ERRORS, Setting

JOB = Job(name="t")
KNOBS = knobs_of(JOB)


def test_every_value_makes_a_job_that_is_allowed_and_is_not_the_job_itself():
    settings, _ = settings_of(JOB, KNOBS)
    assert settings[0] == Setting() and settings[0].name == "the job"
    assert len({setting.name for setting in settings}) == len(settings) > 40
    for setting in settings[1:]:
        assert apply(JOB, setting.changes) != JOB


def test_of_each_knob_the_defaults_have_a_value_that_is_not_measured_twice():
    for knob in KNOBS:
        labels = [value.label for value in knob.values if apply(JOB, value.changes) == JOB]
        assert labels, knob.name
        settings, _ = settings_of(JOB, [knob])
        assert f"{knob.name}={labels[0]}" not in {setting.name for setting in settings}


def test_every_part_of_a_scene_that_has_errors_has_a_knob_and_no_other_has():
    captured = knobs_of(Job.model_validate({"name": "t", "captures": {}}))
    assert {knob.group for knob in (*KNOBS, *captured)} == {kind.group for kind in ERRORS.values()}


def test_another_image_size_is_the_same_picture():
    small = apply(JOB, next(k for k in KNOBS if k.name == "size").values[0].changes).cameras.sensor
    whole = JOB.cameras.sensor
    assert (small.width, small.height) == (160, 120)
    assert small.fx / small.width == pytest.approx(whole.fx / whole.width)
    assert small.cy / small.height == pytest.approx(whole.cy / whole.height)


def test_depth_units_that_16_bits_cannot_hold_are_no_values():
    far = apply(JOB, {"images.depth_range_m": [0.2, 20.0], "images.depth_units_per_m": 1000})
    units = next(knob for knob in knobs_of(far) if knob.name == "units")
    assert [value.label for value in units.values] == ["1000", "2000"]


def test_tolerances_of_convex_parts_are_turned_where_shapes_come_from_outside(tmp_path):
    def labels(job: Job) -> list[str]:
        return [value.label for value in next(k for k in knobs_of(job) if k.name == "collision").values]

    outside = apply(JOB, {"assets.objects": [{"source": "urdf", "folder": str(tmp_path)}]})
    assert labels(JOB) == ["box", "hull", "planned", "parts"]
    assert labels(outside) == ["box", "hull", "planned", "parts to 0.1", "parts to 0.05", "parts to 0.02"]


def test_without_its_package_the_path_traced_tier_is_left_out_with_the_remedy(monkeypatch):
    monkeypatch.setattr(knobs, "find_spec", lambda name: None)
    settings, left_out = settings_of(JOB, KNOBS)
    assert not [setting for setting in settings if "path" in setting.name]
    assert len(left_out) == 1 and "./verso extra pathtraced" in left_out[0] and "path-16" in left_out[0]


def test_an_unknown_knob_is_told_with_the_nearest_and_all_that_are_known():
    with pytest.raises(InputError, match=r"--knobs stepp: there is no such knob; did you mean 'step'\?.*iterations"):
        choose_knobs(KNOBS, ["stepp"])
    assert [knob.name for knob in choose_knobs(KNOBS, ["size", "step", "size"])] == ["size", "step"]
    assert choose_knobs(KNOBS, None) == KNOBS


def test_settings_of_several_knobs_have_all_their_keys():
    both = joined([Setting((("a", "1"),), {"x.y": 1}), Setting((("b", "2"),), {"x.z": 2})])
    assert both.name == "a=1, b=2" and dict(both.changes) == {"x.y": 1, "x.z": 2}


def test_what_is_no_knobs_changes_every_part_of_a_scene():
    known = {knob.name: knob for knob in KNOBS}
    assert groups_of(Setting((("step", "60"),)), known) == {"physics"}
    assert groups_of(Setting((("step", "60"), ("colour", "flat"))), known) == {"physics", "colour"}
    everything = {"physics", "labels", "mirror", "colour", "capture"}
    assert groups_of(Setting(), known) == groups_of(Setting((("preset", "fast"),)), known) == everything


def test_a_key_is_set_in_a_tree_that_lacks_its_branch():
    tree = job_tree_with({"a.c": 2, "d.e.f": 3}, {"a": {"b": 1}})
    assert tree == {"a": {"b": 1, "c": 2}, "d": {"e": {"f": 3}}}


def test_a_value_that_the_job_cannot_have_is_told_by_its_key():
    with pytest.raises(InputError, match=r"physics\.step_hz"):
        apply(JOB, {"physics.step_hz": 1})
