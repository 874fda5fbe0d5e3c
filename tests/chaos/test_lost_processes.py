"""`verso run` from a terminal, while one of its processes is killed or stopped: one line, exit 1, nothing left behind."""

import json
import os
import signal
from pathlib import Path

import pytest

from tests.kit.killed_runs import EndedRun, chain_of, disturb_at_first_commit, kill_processes

pytestmark = [pytest.mark.ray, pytest.mark.minute]

JOB = {
    "name": "small",
    "scenes": 4000,
    "cameras": {"sensor": {"width": 64, "height": 48, "fx": 52.5, "fy": 52.5, "cx": 32.0, "cy": 24.0}},
    "images": {"patch": {"width": 16, "height": 12}},
    "check": {"mirror_agreement_mm": 20.0},
    "run": {"range_size": 4},
}
KEPT = "what is committed is kept, the same command goes on from there"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The temporary folder of the run, in which nothing may stay."""
    folder = tmp_path / "t"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


def disturbed(tmp_path: Path, disturb, **settings) -> EndedRun:
    (tmp_path / "small.yaml").write_text(json.dumps(JOB))
    return disturb_at_first_commit(tmp_path / "small.yaml", tmp_path / "out", disturb, **settings)


def line_of(run: EndedRun) -> str:
    """What it told beside its progress, all of it in one line of ours."""
    assert run.code == 1, run.told
    told = [line.replace("\x1b[K", "") for line in run.told.splitlines()]
    lines = [line for line in told if not line.startswith(f"{JOB['name']}: ") and line.strip("\x1b[0m ")]
    assert len(lines) == 1, run.told
    assert run.left == []
    return lines[0].strip("\x1b[0m ")


@pytest.mark.parametrize(
    ("title", "words"),
    [
        ("ray::DashboardAgent", "the run ended without a word (exit code 1), as it does where Ray is lost"),
        pytest.param("ray::RuntimeEnvAgent", "as it does where Ray is lost", marks=pytest.mark.slow),
        pytest.param("raylet/raylet", "as it does where Ray is lost", marks=pytest.mark.slow),
        pytest.param("gcs/gcs_server", "as it does where Ray is lost", marks=pytest.mark.slow),
    ],
)
def test_losing_a_process_of_rays_is_one_line(tmp_path, folder, title, words):
    run = disturbed(tmp_path, kill_processes(title, signal.SIGKILL))
    line = line_of(run)
    assert line.startswith("verso: ")
    assert words in line
    assert KEPT in line
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    "number",
    [signal.SIGTERM, *(pytest.param(other, marks=pytest.mark.slow) for other in (signal.SIGHUP, signal.SIGQUIT))],
)
def test_a_signal_to_the_command_is_one_line(tmp_path, folder, number):
    run = disturbed(tmp_path, lambda pid, terminal: os.kill(pid, number))
    assert line_of(run) == f"verso: stopped by {number.name}; {KEPT}"
    assert list(folder.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "words"),
    [(signal.SIGKILL, "was killed (SIGKILL)"), (signal.SIGTERM, "verso: "), (signal.SIGABRT, "crashed")],
)
def test_the_death_of_the_driver_is_one_line(tmp_path, folder, number, words):
    run = disturbed(tmp_path, lambda pid, terminal: os.kill(chain_of(pid)[2], number))
    line = line_of(run)
    assert words in line
    assert KEPT in line
    assert list(folder.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("killed", [1, 2, 3])
def test_what_remains_after_a_kill_of_the_command_its_keeper_and_its_driver_ends_by_itself(tmp_path, folder, killed):
    def kill(pid: int, terminal: int) -> None:
        for target in chain_of(pid)[:killed]:
            os.kill(target, signal.SIGKILL)

    run = disturbed(tmp_path, kill, patience_s=30)
    assert run.code == -signal.SIGKILL
    assert run.left == []
    assert list(folder.iterdir()) == []
