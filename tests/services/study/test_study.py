"""The study: its pool of processes, the times of a longer measurement, and what a journal must have alike."""

from dataclasses import replace
from pathlib import Path

from schemas.job.job import Job
from services.study.measure import measure_settling
from services.study.model import Plan, Setting, Sizes
from services.study.study import Unit, header_of, measure_in_pool, with_time_of
from tests.made_up_studies import row
from workers.assets.catalogue import open_catalogue
from workers.scene.context import open_worker

JOB = Job(name="t", seed=2024)
PLAN = Plan(JOB, Path(), (), (Setting(),), (), None, Sizes(scenes=4))


def test_a_pool_gives_the_answers_of_one_process_by_the_units_names():
    unit = Unit("alone/settling/0", "settling", (Setting(),), 0)
    context = open_worker(JOB, open_catalogue(JOB.assets, Path(), tuple(JOB.categories)))
    expected = measure_settling(context, unit.settings, 0, posed=False, released=False)
    assert dict(measure_in_pool(JOB, Path(), 1, [unit])) == {unit.name: expected}
    assert list(measure_in_pool(JOB, Path(), 1, [])) == []


def test_a_longer_measurement_gives_the_time_and_nothing_else():
    found = with_time_of(row("step=1", 2.0, depth_mm=0.1), row("step=1", 1.5), 100.0)
    assert (found.ms, found.ratio, found.ratio_least) == (150.0, 1.5, 1.5 * 0.98)
    assert found.errors["depth_mm"].value == 0.1


def test_a_journal_goes_on_only_with_the_same_sizes_and_code():
    header = header_of(PLAN, "digest", "code")
    assert header == header_of(replace(PLAN, targets={"depth_mm": 0.1}), "digest", "code")
    assert header != header_of(replace(PLAN, sizes=Sizes(scenes=5)), "digest", "code")
    assert header != header_of(PLAN, "digest", "other")
