"""`./verso test`: what the launcher starts for it, what its exit code is, and what the tests' own plugins tell."""

import json
import os
import shutil
import subprocess
import sys

import pytest

from tests.conftest import changed, why_skip
from tests.kit.skips import Skips
from tests.launcher.conftest import ROOT

PYTEST = "pytest|-n|auto|--dist=loadfile|--no-loadscope-reorder|"
STYLE = ["ruff check .", "ruff format --check .", "mypy", "layers"]


def test_a_whole_run_checks_style_beside_the_tests_in_the_stacks_environment(checkout):
    code, out, _ = checkout.run("test", "--ci", "-k", "plane or sphere", "-x")
    assert code == 0
    root = checkout.root
    assert out == f"{PYTEST}--scope=ci|-k|plane or sphere|-x|path={root}|threads=1|in={root}|" + "\n".join(STYLE) + "\n"
    checkout.fault("mypy-fails")
    code, out, _ = checkout.run("test")
    assert code == 1 and out.endswith("FAILED: mypy\n") and "layers" in out


def test_a_path_narrows_to_its_tests_and_leaves_the_style_out(checkout, tmp_path):
    (tmp_path / "cases").mkdir()
    words = ("cases::test_a[x/y]", "--all", "--figures", "figures.json")
    code, out, _ = checkout.run("test", *words, cwd=tmp_path)
    assert code == 0
    told = f"--scope=all|--figures={tmp_path}/figures.json|{tmp_path}/cases::test_a[x/y]|"
    assert out == f"{PYTEST}{told}path={checkout.root}|threads=1|in={checkout.root}|"


def test_its_exit_code_is_0_1_or_2(checkout):
    for status, code in ((0, 0), (1, 1), (2, 1), (4, 2), (5, 1)):  # 5: no test was found
        (checkout.faults / "pytest").write_text(str(status))
        assert checkout.run("test")[0] == code
    for words in (("tests/absent.py",), ("--figures",), ("-k",)):
        code, out, err = checkout.run("test", *words)
        assert (code, out) == (2, "") and words[0] in err
    assert checkout.run("test", "--help")[1].startswith("test|--help|")


# ------------------------------------------------------------------------------------------------ the plugins

SUITE = """
import numpy, pytest

@pytest.mark.slow
def test_slow():
    pass

@pytest.mark.parametrize("phase", range(2))
def test_moon(phase):
    pytest.skip("the moon is full")

@pytest.mark.xfail(reason="not understood")
def test_wrong():
    assert []

def test_measures(record_figure):
    record_figure("plane", "made", numpy.float32(0.25), 1)
"""

FAILING = """
def test_measures_and_fails(record_figure):
    record_figure("sphere", "made", 7, 5)
    assert []

def test_fails_before_it_measures(record_figure):
    assert []
"""


@pytest.fixture
def project(tmp_path):
    """A small project with this project's conftest."""
    (tmp_path / "tests" / "kit").mkdir(parents=True)
    for name in ("conftest.py", "kit/skips.py"):
        shutil.copy(ROOT / "tests" / name, tmp_path / "tests" / name)
    for name in ("schemas", "services"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "pyproject.toml").write_text(
        '[tool.pytest.ini_options]\nmarkers = ["slow: slow"]\npythonpath = ["."]\n'
    )
    (tmp_path / "tests" / "expected_skips.txt").write_text("# why\nslow: *\n")
    (tmp_path / "tests" / "test_suite.py").write_text(SUITE)
    return tmp_path


def run_suite(project, *words):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    environ = {**os.environ, "PYTHONPATH": str(project), "PYTEST_ADDOPTS": ""}
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, check=False, env=environ)
    return done.returncode, done.stdout


@pytest.mark.minute
def test_skips_are_told_by_reason_and_figures_come_in_one_list_from_all_processes(project):
    strange = "skipped although expected_skips.txt does not expect it, and why:\n     2 x the moon is full\n"
    code, out = run_suite(project, "--scope=ci", "-n", "2")
    assert code == 1, "a skip that nobody expected"
    assert "skipped, and why:\n     2 x the moon is full\n     1 x slow: runs with --all\n" in out and strange in out
    assert "known failures, and why:\n     1 x not understood\n" in out
    (project / "tests" / "expected_skips.txt").write_text("the moon is *\n")
    code, out = run_suite(project, "--scope=all")
    assert code == 0 and "although" not in out and "slow" not in out
    (project / "tests" / "test_failing.py").write_text(FAILING)
    assert run_suite(project, "-n", "2", "--figures", "figures.json")[0] == 1
    assert json.loads((project / "figures.json").read_text()) == [
        {"name": "plane", "outcome": "made", "figure": 0.25, "bound": 1.0},
        {"name": "sphere", "outcome": "failed", "figure": 7.0, "bound": 5.0},
        {"name": "test_fails_before_it_measures", "outcome": "failed", "figure": None, "bound": None},
    ]


def test_the_list_of_this_project_expects_what_the_markers_skip():
    expected = Skips(must_be_expected=True)
    for scope in ("default", "ci", "all"):
        for marker in ("slow", "minute", "docker", "root", "browser", "shared_data"):
            reason = why_skip({marker}, scope)
            expected._skips[f"{scope} {marker}"] = reason or "no Docker engine answers"
    assert not expected.unexpected()


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_a_change_is_told_from_none(tmp_path, monkeypatch):
    def git(*words: str, **environ: str) -> None:
        who = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", *who, *words], cwd=tmp_path, check=True, capture_output=True, env=os.environ | environ)

    monkeypatch.setattr("tests.conftest.ROOT", tmp_path)
    assert changed.__wrapped__("deploy")  # no repository: nobody can tell
    git("init", "-b", "main")
    for name in ("deploy", "report"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text("a")
    git("add", ".")
    git("commit", "-m", "a")
    assert changed.__wrapped__("deploy")  # nothing to compare with
    git("checkout", "-b", "branch")
    (tmp_path / "report" / "a").write_text("b")
    git("commit", "-am", "b")
    assert changed.__wrapped__("report") and not changed.__wrapped__("deploy")
    git("checkout", "main")
    git("commit", "--amend", "-m", "a", GIT_COMMITTER_DATE="2020-01-01T00:00:00Z")
    assert changed.__wrapped__("deploy")  # as old as all there is
    (tmp_path / "report" / "a").write_text("c")
    git("commit", "-am", "c")  # on the main branch, today
    assert changed.__wrapped__("report") and not changed.__wrapped__("deploy")
