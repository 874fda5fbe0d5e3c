"""Presets: defaults under the keys of a job, held to the measurement that is kept in docs/tradeoff."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from schemas.job.identity import settings_digest
from schemas.job.job import PRESETS, Job
from services.study.choose import error_of, own_row
from services.study.knobs import apply
from services.study.model import ERRORS, Figure, Row, Setting
from services.study.study import NEGLIGIBLE
from tests.stored_studies import read_study

EVIDENCE = Path(__file__).resolve().parents[3] / "docs" / "tradeoff"

SLACK = 0.1
"""A preset may take a tenth more time than a setting that is as good, and have errors a tenth larger than one as cheap."""

MORE_EFFORT = (
    "physics.max_step_travel_mm",
    "physics.solver_iterations",
    "physics.rest.speed_mm_s",
    "physics.rest.spin_rad_s",
    "physics.collision",
    "physics.exact_rest",
    "render.path_samples",
)

BY_EFFORT = frozenset((*PRESETS["balanced"], *MORE_EFFORT))
"""The keys that presets choose or could. Settings that change other keys store other things, and are no rivals."""


def preset_row(rows: Sequence[Row], name: str) -> Row:
    """The row of a preset; that of the job where no preset's row has the name, as the job has one of them itself."""
    return next((row for row in rows if row.setting.parts == (("preset", name),)), own_row(rows))


def rivals(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if set(row.setting.changes) <= BY_EFFORT]


def better_than(preset: Row, rows: Sequence[Row], slack: float = SLACK) -> list[str]:
    """Names of rivals that put a preset off the front.

    One that is no worse in any error, and cheaper by more than the slack; or one that is no dearer and no worse in any
    error, and better in one by more than the slack, beyond the noise of either.
    """
    found = []
    for rival in rivals(rows):
        pairs = list(compared(rival, preset, rows))
        if rival.setting == preset.setting or any(
            theirs.value > max(ours.value, least) for theirs, ours, least in pairs
        ):
            continue
        better = any(ours.value > least and theirs.high * (1.0 + slack) < ours.low for theirs, ours, least in pairs)
        if rival.ratio * (1.0 + slack) < preset.ratio or (rival.ratio <= preset.ratio and better):
            found.append(rival.setting.name)
    return found


def compared(rival: Row, preset: Row, rows: Sequence[Row]) -> Iterator[tuple[Figure, Figure, float]]:
    """Both figures of each error that both have, and what is negligible of it."""
    for name, kind in ERRORS.items():
        theirs, ours = error_of(rival, name, rows), error_of(preset, name, rows)
        if theirs and ours:
            yield theirs, ours, NEGLIGIBLE[kind.unit]


def value_at(job: Job, path: str) -> object:
    place: object = job
    for part in path.split("."):
        place = getattr(place, part)
    return place


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_gives_every_key_that_the_job_does_not(name):
    job = Job.model_validate({"name": "t", "preset": name})
    for path, value in PRESETS[name].items():
        assert value_at(job, path) == value


def test_what_the_job_says_itself_wins():
    job = Job.model_validate({"name": "t", "preset": "fast", "render": {"tier": "raster"}})
    assert job.render.tier == "raster" and job.physics.step_hz == PRESETS["fast"]["physics.step_hz"]


def test_balanced_is_what_the_keys_say_without_a_preset():
    assert {path: value_at(Job(name="t"), path) for path in PRESETS["balanced"]} == PRESETS["balanced"]
    assert len({frozenset(changes) for changes in PRESETS.values()}) == 1


def test_a_preset_makes_the_same_dataset_as_its_keys():
    named = Job.model_validate({"name": "t", "preset": "exact"})
    spelt = apply(Job(name="t"), PRESETS["exact"])
    assert settings_digest(named, "x") == settings_digest(spelt, "x") != settings_digest(Job(name="t"), "x")


@pytest.mark.parametrize("job", [Job(name="t", preset="fast"), Job(name="t", preset="exact")])
def test_a_job_that_was_written_down_is_the_same_when_it_is_read(job):
    assert Job.model_validate_json(job.model_dump_json()) == job


@pytest.mark.parametrize("name", list(PRESETS))
def test_no_measured_setting_is_better_than_a_preset_by_more_than_the_slack(name):
    rows = read_study(EVIDENCE).rows
    row = preset_row(rows, name)
    assert row.setting.parts or name == "balanced"
    if row.setting.parts:
        assert dict(row.setting.changes) == PRESETS[name], "measure docs/tradeoff again: its preset has other keys"
    assert len(rivals(rows)) > 8
    assert better_than(row, rows) == []


def made(name: str, ratio: float, depth: float) -> Row:
    key = {"": {}, "preset": {"render.tier": "flat"}}.get(name, {"physics.step_hz": 1})
    figure = Figure(depth, depth, depth, depth, 9)
    setting = Setting(((name, "x"),) if name else (), key)
    return Row(setting, ratio, ratio, ratio, ratio, 1.0, {"depth_mm": figure}, 0.0)


@pytest.mark.parametrize(
    ("ratio", "depth", "off"),
    [
        (0.92, 1.0, False),  # within the slack
        (0.8, 1.0, True),  # cheaper by more
        (0.8, 1.05, False),  # and worse
        (1.0, 0.95, False),
        (1.0, 0.8, True),  # as cheap, and better by more
        (1.01, 0.8, False),  # dearer, and better: another point of the front
    ],
)
def test_a_preset_is_off_the_front_where_a_rival_beats_it_by_more_than_the_slack(ratio, depth, off):
    assert SLACK == 0.1
    rows = [made("", 3.0, 9.0), made("preset", 1.0, 1.0), made("rival", ratio, depth)]
    assert (better_than(rows[1], rows) == ["rival=x"]) == off


def test_settings_that_store_something_else_are_no_rivals():
    small = made("size", 0.1, 0.1)
    small = Row(Setting((("size", "160"),), {"cameras.sensor.width": 160}), 0.1, 0.1, 0.1, 0.1, 1.0, small.errors, 0.0)
    rows = [made("", 3.0, 9.0), made("preset", 1.0, 1.0), small]
    assert better_than(rows[1], rows) == []
