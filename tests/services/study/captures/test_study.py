from contextlib import closing
from pathlib import Path

import pytest

from schemas.errors import InputError
from schemas.job.job import Job
from services.run.progress import ProgressLine
from services.study import command as study
from services.study.command import check_captures, rows_of, run_capture_study
from services.study.model import Plan, Setting, Sizes
from services.study.study import Journal

OWN, COARSE, HOPELESS = Setting(), Setting((("voxel", "0.006"),)), Setting((("views", "4"),))


def plan(captures: dict, count: int = 2) -> Plan:
    job = Job.model_validate({"name": "t", "scenes": count, "captures": captures})
    return Plan(job, Path(), (), (OWN, COARSE, HOPELESS), (), None, Sizes(scenes=count, settled=0, laps=2))


def answer(own_s: float, coarse_s: float) -> dict:
    return {
        "whole": {OWN.name: own_s, COARSE.name: coarse_s},
        "settling": {},
        "bytes": {OWN.name: 2000, COARSE.name: 500},
        "errors": {OWN.name: {"cloud_mm": 0.2}, COARSE.name: {"cloud_mm": 0.8}},
        "failed": {HOPELESS.name: "poses: too few views"},
        "cold": own_s,
    }


def test_a_row_has_the_ratio_of_times_over_captures_and_the_worst_errors():
    laps = [{0: answer(4.0, 1.0), 1: answer(8.0, 2.0)}, {0: answer(4.0, 1.0), 1: answer(8.0, 2.0)}]
    own, coarse = rows_of(plan({}), laps)
    assert (own.ratio, own.ms, own.kilobytes) == (1.0, 6000.0, 2.0)
    assert (coarse.ratio, coarse.ms, coarse.kilobytes) == (0.25, 1500.0, 0.5)
    assert coarse.errors["cloud_mm"].value == 0.8


def test_a_setting_that_some_captures_cannot_be_made_with_says_why():
    first = answer(4.0, 1.0) | {"failed": {COARSE.name: "fuse: nothing is seen"}}
    del first["whole"][COARSE.name], first["errors"][COARSE.name], first["bytes"][COARSE.name]
    laps = [{0: first, 1: answer(8.0, 2.0)}] * 2
    coarse = rows_of(plan({}), laps)[1]
    assert coarse.failed_share == 0.5 and coarse.notes == ("fuse: nothing is seen",)


def test_a_study_warms_up_once_and_measures_what_its_journal_lacks(monkeypatch, tmp_path):
    done: list[tuple] = []
    monkeypatch.setattr(study, "simulate_one", lambda context, scene, path: done.append(("simulate", scene)))
    monkeypatch.setattr(study, "warm_up", lambda context, setting, path: done.append(("warm", setting.name)))

    def measure(context, settings, path, unit):
        done.append(("measure", *unit))
        return answer(4.0, 1.0)

    monkeypatch.setattr(study, "measure_capture", measure)
    with Journal(tmp_path, {}) as journal, closing(ProgressLine(0, "test", unit="measurement")) as progress:
        journal.add("captures/0/0", answer(4.0, 1.0))
        rows = run_capture_study(plan({}, count=3), journal, None, progress)
        assert [row.setting for row in rows] == [OWN, COARSE]
        assert done[:3] == [("simulate", 0), ("warm", OWN.name), ("measure", 0, 1)]
        assert done[3:] == [
            (step, n, *lap) for n in (1, 2) for step, *lap in (("simulate",), ("measure", 0), ("measure", 1))
        ]
        done.clear()
        assert run_capture_study(plan({}, count=3), journal, None, progress) == rows and done == []


def test_captures_without_truth_and_a_single_capture_are_refused():
    with pytest.raises(InputError, match=r"captures\.source"):
        check_captures(plan({"source": "folders", "folders": ["a", "b"]}))
    with pytest.raises(InputError, match="1 capture cannot tell"):
        check_captures(plan({"simulate": {"views": 8}}, count=1))
