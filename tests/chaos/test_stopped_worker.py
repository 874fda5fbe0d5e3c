"""A worker that is stopped while it works: the run says so, ends it, and makes the dataset that it always makes."""

import contextlib
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from services.job.job_file import validate_job
from services.read.query import query
from services.run import coordinator
from services.run.ray_cluster import Slots, private_ray
from services.run.run_job import RunRequest, run_job
from tests.chaos.test_lost_processes import JOB
from tests.kit.killed_runs import disturbed_scene
from workers.store.local import LocalStore

pytestmark = [pytest.mark.ray, pytest.mark.minute]

RUN = {"range_size": 4, "max_failure_share": 0.5, "max_attempts": 1, "scene_timeout_s": 6.0}
SMALL: dict[str, Any] = {**JOB, "scenes": 8, "run": RUN}


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
    told = [line for line in capfd.readouterr().err.splitlines() if "no progress" in line]
    for pid, line in zip(stopped, told, strict=True):
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
