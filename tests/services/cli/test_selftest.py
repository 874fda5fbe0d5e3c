import json
import shutil
import sys
from pathlib import Path

import pytest

from services.cli import selftest

SUITE = """
import numpy
import pytest

def test_passes():
    pass

@pytest.mark.slow
def test_slow():
    pass

def test_measures(record_figure):
    record_figure("plane", "made", numpy.float32(0.25), 1)

def test_measures_and_fails(record_figure):
    record_figure("sphere", "made", 7, 5)
    assert MEASURED < 5

def test_fails_before_it_measures(record_figure):
    assert MEASURED < 5
"""


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A small project with this project's conftest, which `selftest` takes for its own."""
    (tmp_path / "tests").mkdir()
    shutil.copy(selftest.ROOT / "tests" / "conftest.py", tmp_path / "tests")
    (tmp_path / "pyproject.toml").write_text('[tool.pytest.ini_options]\nmarkers = ["slow: slow"]\naddopts = "-ra"\n')
    (tmp_path / "schemas").symlink_to(selftest.ROOT / "schemas")
    (tmp_path / "services").symlink_to(selftest.ROOT / "services")
    monkeypatch.setattr(selftest, "ROOT", tmp_path)
    monkeypatch.setattr(selftest, "_static_checks", lambda: {"static": [sys.executable, "-c", "print('checked')"]})
    monkeypatch.setattr(selftest, "usable_cores", lambda: 1)  # more would only take longer
    monkeypatch.setattr(selftest, "LAST_RUN", tmp_path / "seconds.json")
    (tmp_path / "tests" / "expected_skips.txt").write_text("not --all | * | slow: *\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_suite(project: Path, measured: int) -> None:
    (project / "tests" / "test_suite.py").write_text(f"MEASURED = {measured}\n{SUITE}")


def test_all_passing_is_0_and_skips_are_explained(project, capfd):
    write_suite(project, measured=3)
    assert selftest.main([]) == 0
    out = capfd.readouterr().out
    assert out.startswith("verso test: about 13 minutes on 1 core, an estimate\n== static")
    assert "checked" in out
    (seconds,) = json.loads(selftest.LAST_RUN.read_text()).values()
    assert 0 < seconds < 300
    assert "4 passed, 0 failed, 1 skipped" in out
    assert "   1 x slow: runs with --all" in out


def test_all_runs_the_slow_tests_too(project, capfd):
    write_suite(project, measured=3)
    assert selftest.main(["--all"]) == 0
    assert "5 passed, 0 failed, 0 skipped" in capfd.readouterr().out


def test_the_duration_is_that_of_the_last_run_here_or_the_measured_one(tmp_path, monkeypatch):
    monkeypatch.setattr(selftest, "LAST_RUN", tmp_path / "seconds.json")
    assert selftest.expected_duration("default", 1) == "about 13 minutes on 1 core, an estimate"
    selftest.LAST_RUN.write_text('{"default 1": 420}')
    assert selftest.expected_duration("default", 1) == "about 7 minutes on 1 core, as the last time"
    assert selftest.expected_duration("default", 2) == "about 7 minutes on 2 cores, an estimate"
    for torn in ("[torn", "[]", '{"default 2": "x"}'):
        selftest.LAST_RUN.write_text(torn)
        assert selftest.expected_duration("default", 2) == "about 7 minutes on 2 cores, an estimate"


SKIPS = """
import pytest

@pytest.mark.skip(reason="the moon is full")
def test_moon():
    pass

@pytest.mark.xfail(reason="not understood")
def test_wrong():
    assert []
"""


def test_a_skip_that_is_not_expected_fails_in_ci(project, capfd):
    (project / "tests" / "test_moon.py").write_text(SKIPS)
    assert selftest.main(["--ci"]) == 1
    out = capfd.readouterr().out
    assert "skips        FAILED" in out
    assert "not expected, 1 x tests/test_moon.py::test_moon: the moon is full" in out


def test_a_skip_that_is_not_expected_is_told_where_it_does_not_fail(project):
    skips = [("tests/test_moon.py::test_moon", "the moon is full")]
    check, told = selftest.check_skips(skips, "default")
    assert not check.passed
    assert told[0] == "  not expected, 1 x tests/test_moon.py::test_moon: the moon is full"


def test_an_expected_skip_passes_in_ci_and_a_line_of_no_use_is_told(project, capfd):
    (project / "tests" / "test_moon.py").write_text(SKIPS)
    (project / "tests" / "expected_skips.txt").write_text(
        "# why\nalways | tests/test_moon.py::* | the moon is *\nalways | tests/test_sun.py::* | the sun is full\n"
    )
    assert selftest.main(["--ci"]) == 0
    out = capfd.readouterr().out
    assert "skips        ok" in out and "0 not in tests/expected_skips.txt, 1 of its lines without use here" in out
    assert "expected and not skipped: always | tests/test_sun.py::* | the sun is full" in out
    assert "0 passed, 0 failed, 1 skipped" in out  # a known failure is no skip
    assert "known failures, and why:\n     1 x not understood" in out


def test_a_failing_test_is_1(project, capfd):
    write_suite(project, measured=9)
    assert selftest.main(["tests"]) == 1
    assert "2 passed, 2 failed, 1 skipped" in capfd.readouterr().out


def test_a_failing_check_is_1_although_every_test_passes(project, monkeypatch, capfd):
    write_suite(project, measured=3)
    monkeypatch.setattr(selftest, "_static_checks", lambda: {"static": [sys.executable, "-c", "raise SystemExit(3)"]})
    assert selftest.main([]) == 1
    assert "static       FAILED" in capfd.readouterr().out


def test_a_path_narrows_to_its_tests_and_skips_the_checks(project, capfd):
    write_suite(project, measured=3)
    assert selftest.main(["tests/test_suite.py::test_passes"]) == 0
    out = capfd.readouterr().out
    assert "checked" not in out
    assert "1 passed, 0 failed" in out


def test_an_expression_narrows_by_name(project, capfd):
    write_suite(project, measured=9)
    assert selftest.main(["-k", "passes"]) == 0
    out = capfd.readouterr().out
    assert "1 passed, 0 failed" in out
    assert "minutes" not in out and not selftest.LAST_RUN.exists()  # a part of the tests tells nothing of the whole


def test_finding_no_test_is_not_success(project, capfd):
    (project / "tests" / "test_empty.py").touch()
    assert selftest.main([]) == 1
    assert "no test was found" in capfd.readouterr().out


def test_a_path_that_does_not_exist_is_2(project, capfd):
    assert selftest.main(["tests/absent.py"]) == 2
    assert "tests/absent.py" in capfd.readouterr().err


def test_outside_a_checkout_it_says_where_the_tests_are(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(selftest, "ROOT", tmp_path)
    assert selftest.main([]) == 2
    assert "checkout" in capfd.readouterr().err


@pytest.mark.minute
def test_figures_of_all_processes_come_in_one_list_and_a_failed_case_says_so(project, monkeypatch):
    write_suite(project, measured=9)
    monkeypatch.setattr(selftest, "usable_cores", lambda: 2)
    elsewhere = project / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    selftest.main(["../tests", "--figures", "figures.json"])
    assert json.loads((elsewhere / "figures.json").read_text()) == [
        {"name": "plane", "outcome": "made", "figure": 0.25, "bound": 1.0},
        {"name": "sphere", "outcome": "failed", "figure": 7.0, "bound": 5.0},
        {"name": "test_fails_before_it_measures", "outcome": "failed", "figure": None, "bound": None},
    ]


def test_a_run_that_died_before_writing_counts_nothing(tmp_path):
    assert selftest.Tally.read(tmp_path / "absent.xml") == selftest.Tally(0, 0)
    (tmp_path / "torn.xml").write_text("<testsuites><testsu")
    assert selftest.Tally.read(tmp_path / "torn.xml") == selftest.Tally(0, 0)
