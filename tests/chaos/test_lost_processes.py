"""`verso run` from a terminal while one of its processes is killed: one line, exit 1, nothing left behind; and a worker that is
stopped while it works: the run says so, ends it, and makes the dataset that it always makes.
"""

import contextlib
import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from services.job.job_file import validate_job
from services.read.query import query
from services.run import coordinator
from services.run.ray_cluster import Slots, private_ray
from services.run.run_job import RunRequest, run_job
from tests.kit.killed_runs import (
    EndedRun,
    chain_of,
    disturb_at_first_commit,
    disturbed_scene,
    interrupt,
    kill_processes,
)
from workers.store.local import LocalStore

pytestmark = [pytest.mark.ray, pytest.mark.minute]

JOB: dict[str, Any] = {
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


# ---------------------------------------------------------------------------------------------- workers that are stopped

RUN = {"range_size": 4, "max_failure_share": 0.5, "max_attempts": 1, "scene_timeout_s": 6.0}
SMALL = {**JOB, "scenes": 8, "run": RUN}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Slots]:
    with private_ray(1) as slots:
        yield slots


def make(out: Path, retry_failed: bool = False, **changes):
    request = RunRequest(validate_job({**SMALL, **changes}, "test"), Path(), str(out), retry_failed=retry_failed)
    return run_job(request, contextlib.nullcontext(Slots(1, 1))).merged


def test_a_worker_stopped_in_a_scene_is_told_ended_and_blamed_for_time(cluster, tmp_path, capfd):
    begun = time.monotonic()
    with disturbed_scene(tmp_path, 5, signal.SIGSTOP) as stopped:
        merged = make(tmp_path)
    assert time.monotonic() - begun < 120
    assert len(stopped) == 1
    assert merged.scenes == {"made": 7, "intrinsic": 0, "environmental": 1}
    (row,) = query(LocalStore(tmp_path), "select * from failures").to_pylist()
    assert (row["scene_id"], row["kind"], row["reason"], row["attempts"]) == (5, "environmental", "time", 1)
    lines = [line for line in capfd.readouterr().err.splitlines() if "no progress" in line]
    for pid, line in zip(stopped, lines, strict=True):
        assert line.startswith("verso: range from 4, scene 5: no progress for ")
        assert f"by process {pid} on {socket.gethostname()}, which was stopped by a signal" in line
    assert make(tmp_path, retry_failed=True).scenes == {"made": 8, "intrinsic": 0, "environmental": 0}


@pytest.mark.slow
def test_a_worker_on_another_node_is_ended_there(cluster, tmp_path, monkeypatch):
    """The way to other hosts, by a task on the worker's node, taken to a worker of this one."""
    monkeypatch.setattr(coordinator, "find_own_workers", list)
    with disturbed_scene(tmp_path, 5, signal.SIGSTOP) as stopped:
        merged = make(tmp_path)
    assert len(stopped) == 1
    assert merged.scenes == {"made": 7, "intrinsic": 0, "environmental": 1}


@pytest.mark.slow
def test_a_worker_stopped_while_it_commits_is_told_and_ended_and_nothing_is_lost(cluster, tmp_path, capfd):
    changes = {"run": {**RUN, "max_attempts": 2}}
    with disturbed_scene(tmp_path, None, signal.SIGSTOP, most=1) as stopped:
        merged = make(tmp_path, **changes)
    assert len(stopped) == 1
    assert merged.scenes == {"made": 8, "intrinsic": 0, "environmental": 0}
    assert capfd.readouterr().err.count(", committing: no progress for ") == 1
    assert merged.digest == make(tmp_path.with_name("undisturbed")).digest
