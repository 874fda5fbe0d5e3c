"""`verso run` from a terminal, while one of its processes is killed or stopped: one line, exit 1, nothing left behind."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.kit.killed_runs import EndedRun, chain_of, disturb_at_first_commit, interrupt, kill_processes

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


def line_of(run: EndedRun) -> str:
    """What it told beside its progress, all of it in one line of ours."""
    assert run.code == 1, run.told
    said = [line.replace("\x1b[K", "") for line in run.told.splitlines()]
    lines = [line for line in said if not line.startswith(f"{JOB['name']}: ") and line.strip("\x1b[0m ")]
    assert len(lines) == 1, run.told
    assert run.left == []
    return lines[0].strip("\x1b[0m ")


def signal_to(number: signal.Signals, link: int) -> Callable[[int, int], None]:
    """Sends a signal to the command (0), its keeper (1) or its driver (2)."""
    return lambda pid, terminal: os.kill(chain_of(pid)[link], number)


LOST = "the run ended without a word (exit code 1), as it does where Ray is lost"
WAYS = {
    "an agent of Ray": (kill_processes("ray::DashboardAgent", signal.SIGKILL), LOST),
    "Ctrl-C": (interrupt, "interrupted"),
    "SIGTERM": (signal_to(signal.SIGTERM, 0), "stopped by SIGTERM"),
    "another agent": (kill_processes("ray::RuntimeEnvAgent", signal.SIGKILL), "as it does where Ray is lost"),
    "the raylet": (kill_processes("raylet/raylet", signal.SIGKILL), "as it does where Ray is lost"),
    "the GCS": (kill_processes("gcs/gcs_server", signal.SIGKILL), "as it does where Ray is lost"),
    "SIGKILL of the driver": (signal_to(signal.SIGKILL, 2), "was killed (SIGKILL)"),
}
"""How a run loses a process or gets a signal, and what it says then; all but the first two are slow."""


@pytest.mark.parametrize(
    "way", [*list(WAYS)[:2], *(pytest.param(name, marks=pytest.mark.slow) for name in list(WAYS)[2:])]
)
def test_a_lost_process_or_a_signal_is_one_line_and_leaves_nothing(tmp_path, folder, way):
    disturb, words = WAYS[way]
    (tmp_path / "small.yaml").write_text(json.dumps(JOB))
    line = line_of(disturb_at_first_commit(tmp_path / "small.yaml", tmp_path / "out", disturb))
    assert line.startswith("verso: ") and words in line and KEPT in line
    assert list(folder.iterdir()) == []
