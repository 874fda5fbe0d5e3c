"""What is measured: knobs, presets, rounds of settings, promising combinations, and the journal of what is done."""

from collections.abc import Sequence
from typing import Any, get_args

import pytest

from schemas.errors import InputError, OutputError
from schemas.job.captures import ESTIMATES
from schemas.job.job import PRESETS, Job, JobKind, kind_of, settings_digest
from services.study import model
from services.study.choose import error_of, own_row, promising
from services.study.model import (
    ERRORS,
    REFERENCES,
    Row,
    Setting,
    apply,
    choose_knobs,
    knobs_of,
    settings_of,
)
from services.study.study import JOURNAL_FILE, Journal
from tests.services.study.made_up import row, stored

JOB = Job(name="t", seed=2024, first_scene=100)
CAPTURES = Job.model_validate({"name": "t", "scenes": 2, "captures": {"simulate": {"views": 12}}})


def test_every_value_makes_a_job_that_is_allowed_and_is_not_the_job_itself():
    for job, least in ((JOB, 40), (CAPTURES, 10)):
        settings = settings_of(job, knobs_of(job))[0]
        assert settings[0] == Setting() and settings[0].name == "the job"
        assert len({setting.name for setting in settings}) == len(settings) > least
        assert all(apply(job, setting.changes) != job for setting in settings[1:])
    for knob, values in knobs_of(JOB).items():  # of each the defaults have a value, which is not measured twice
        own = [label for label, changes in values.items() if apply(JOB, changes) == JOB]
        assert own and f"{knob}={own[0]}" not in {setting.name for setting in settings_of(JOB, {knob: values})[0]}


def test_a_knob_has_the_values_that_mean_something_for_the_job():
    far = apply(JOB, {"images.depth_range_m": [0.2, 20.0], "images.depth_units_per_m": 1000})
    assert list(knobs_of(far)["units"]) == ["1000", "2000"]  # more units than 16 bits hold are no values
    captured = {name: list(values) for name, values in knobs_of(CAPTURES).items()}
    assert (captured["views"], captured["estimate"]) == (["4", "6", "10"], list(ESTIMATES))
    small, whole = apply(JOB, knobs_of(JOB)["size"]["160"]).cameras.sensor, JOB.cameras.sensor
    assert (small.width, small.height, small.fx / small.width) == (160, 120, pytest.approx(whole.fx / whole.width))


def test_the_reference_is_finer_than_anything_that_a_knob_can_be():
    values = [changes for knob in knobs_of(JOB).values() for changes in knob.values()]
    for finer in (reference.changes for reference in REFERENCES):
        for key, value in finer.items():
            sign = -1 if "travel" in key else 1
            assert all(sign * changes.get(key, -sign * 1e9) < sign * value for changes in values), key


def test_what_cannot_be_turned_is_refused_or_left_out(monkeypatch):
    known = knobs_of(JOB)
    with pytest.raises(InputError, match=r"--knobs stepp: there is no such knob; did you mean 'step'\?.*iterations"):
        choose_knobs(known, ["stepp"])
    assert list(choose_knobs(known, ["size", "step", "size"])) == ["size", "step"]
    with pytest.raises(InputError, match=r"physics\.step_hz"):
        apply(JOB, {"physics.step_hz": 1})
    monkeypatch.setattr(model, "find_spec", lambda name: None)
    assert [name for name in knobs_of(JOB)["colour"] if "path" in name] == []


SLACK = 0.1
"""A preset may take a tenth more time than a setting that is as good, and have errors a tenth larger than one as cheap."""

BY_EFFORT = {key for kind in PRESETS.values() for key in kind["balanced"]} | {
    *("physics.max_step_travel_mm", "physics.solver_iterations", "physics.collision"),
    *("physics.rest.speed_mm_s", "physics.exact_rest", "render.path_samples"),
}
"""The keys that presets choose or could. Settings that change other keys store other things, and are no rivals."""


def better_than(preset: Row, rows: Sequence[Row]) -> list[str]:
    """Names of rivals that put a preset off the front.

    One that is no worse in any error, and surely cheaper by more than the slack; or one that is no dearer and no worse in any
    error, and better in one by more than the slack, beyond the noise of either.
    """
    better_rivals = []
    for rival in [one for one in rows if set(one.setting.changes) <= BY_EFFORT and one.setting != preset.setting]:
        both = {name: (error_of(rival, name, rows), error_of(preset, name, rows)) for name in ERRORS}
        pairs = [(a, b, ERRORS[name].negligible) for name, (a, b) in both.items() if a and b]
        if any(theirs.value > max(ours.value, least) for theirs, ours, least in pairs):
            continue
        better = any(ours.value > least and theirs.high * (1.0 + SLACK) < ours.low for theirs, ours, least in pairs)
        if rival.ratio_most * (1.0 + SLACK) < preset.ratio_least or (rival.ratio <= preset.ratio and better):
            better_rivals.append(rival.setting.name)
    return better_rivals


@pytest.mark.parametrize("kind", get_args(JobKind))
def test_no_measured_setting_is_better_than_a_preset_by_more_than_the_slack(kind):
    rows = stored(kind).rows
    assert sum(set(one.setting.changes) <= BY_EFFORT for one in rows) >= 8
    for name, changes in PRESETS[kind].items():
        preset = next((one for one in rows if one.setting.parts == (("preset", name),)), own_row(rows))
        assert preset.setting.parts or name == "balanced"
        stale = "measure docs/tradeoff again: its preset has other keys"
        assert preset.setting.changes.items() <= changes.items(), stale
        assert better_than(preset, rows) == [], name


OF_KIND: dict[JobKind, dict[str, Any]] = {
    "singles": {"objects_per_scene": [1, 1], "assets": {"objects": [{"source": "procedural"}]}, "captures": None},
    "piles": {"objects_per_scene": [1, 3], "assets": {"objects": [{"source": "library", "folder": "x"}]}},
    "meshes": {"assets": {"objects": [{"source": "procedural"}, {"source": "library", "folder": "x"}]}},
    "captures": {"captures": {}},
}


def test_a_preset_makes_the_same_dataset_as_its_keys_and_all_choose_the_same_keys():
    def digest(job: Job) -> str:
        return settings_digest(job, "x")

    for kind, keys in OF_KIND.items():
        for name, changes in PRESETS[kind].items():
            plain, job = (Job.model_validate({"name": "t", **keys, **some}) for some in ({}, {"preset": name}))
            assert kind_of(keys) == kind_of(job.model_dump(mode="json")) == kind
            assert digest(job) == digest(apply(plain, changes)) and changes.keys() == PRESETS[kind]["balanced"].keys()
            assert Job.model_validate_json(job.model_dump_json()) == job
    assert digest(Job(name="t", preset="exact")) != digest(Job(name="t")) == digest(Job(name="t", preset="balanced"))


OWN = row(depth_mm=0.1, mask_share=0.01)

PROMISING: tuple[tuple[dict[str, tuple[float, ...]], set[str]], ...] = (
    ({"a=1": (0.8, 0.1), "b=1": (0.9, 0.1)}, {"a=1, b=1"}),  # both save time and keep every error
    ({"a=1": (0.8, 0.1), "b=1": (0.5, 0.2)}, set()),  # an error grows
    ({"a=1": (0.8, 0.1), "b=1": (0.5, 0.1, 0.1)}, set()),
    ({"a=1": (0.8, 0.1), "a=2": (0.7, 0.1), "b=1": (0.9, 0.1)}, {"a=2, b=1"}),  # the cheapest value of a knob
    ({"a=1": (1.5, 0.04), "b=1": (0.8, 0.1)}, {"a=1, b=1"}),  # mends what the job misses, and saves time
    ({"a=1": (1.5, 0.04), "a=2": (1.3, 0.05), "b=1": (1.2, 0.1, 0.004)}, {"a=2, b=1"}),  # each mends another target
    (
        {"a=1": (0.8, 0.1), "b=1": (0.8001, 0.1)},
        {"a=1, b=1"},
    ),  # in the order of the table, whatever noise makes of ranks
    ({"a=1": (0.8001, 0.1), "b=1": (0.8, 0.1)}, {"a=1, b=1"}),
    (
        {"a=1": (0.8, 0.1), "b=1": (0.9, 0.1), "c=1": (0.7, 0.1)},
        {"a=1, b=1, c=1"},
    ),
)


def test_what_is_measured_together_saves_time_or_mends_what_the_job_misses():
    def names(turned: dict[str, tuple[float, ...]], targets: dict[str, float] | None, own: Row = OWN) -> set[str]:
        rows = [row(name, ratio, depth_mm=d, mask_share=(*m, 0.01)[0]) for name, (ratio, d, *m) in turned.items()]
        return {setting.name for setting in promising([own, *rows], targets)}

    for turned, expected in PROMISING:
        assert names(turned, {"depth_mm": 0.05, "mask_share": 0.005}) == expected, turned
    assert names({"a=1": (0.5, 0.5), "b=1": (0.6, 0.4), "a=2": (0.4, 0.9)}, {"depth_mm": 0.5}) == {"a=1, b=1"}
    kept, lost = ({"a=1": (0.8, depth_mm), "b=1": (0.9, 0.05)} for depth_mm in (0.1, 0.2))  # the default allows 0.1 mm
    assert names(kept, None) == {"a=1, b=1"} and names(lost, None) == set()


HEADER = {"job": "abc", "code": "def"}


def test_a_journal_of_another_study_and_a_folder_that_cannot_be_written_are_refused(tmp_path):
    Journal(tmp_path, HEADER).add("a", 1)
    before = (tmp_path / JOURNAL_FILE).read_bytes()
    with pytest.raises(OutputError, match=r"another study.*: choose another --out"):
        Journal(tmp_path, {**HEADER, "code": "ghi"})
    assert (tmp_path / JOURNAL_FILE).read_bytes() == before
    with pytest.raises(OutputError, match="choose another --out"):
        Journal(tmp_path / JOURNAL_FILE / "study", HEADER)
