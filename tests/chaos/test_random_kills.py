"""Whole runs on a real Ray whose processes are killed at random times, or stopped, until a dataset is done."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.datasets import LOOK
from tests.kit.killed_runs import marked, processes_with

pytestmark = pytest.mark.ray

KILLS = {"ci": 1, "all": 50}
ACTORS = {"driver": "services.cli.main", "worker": "ray::", "raylet": "raylet/raylet", "gcs": "gcs_server"}
"""A part of the command line of each kind of process."""

JOB = """
name: small
seed: 11
scenes: 24
cameras: {sensor: {width: 160, height: 120, fx: 131.25, fy: 131.25, cx: 80.0, cy: 60.0}}
images: {patch: {width: 32, height: 24}}
check: {raycast_share: 0.1, mirror_agreement_mm: 5.0}
run: {range_size: 2, shard_size: 4}
"""
JOB += f"look: {json.dumps(LOOK)}\n"


@dataclass
class Run:
    """A `verso run` in a process of its own, with everything that it started."""

    process: subprocess.Popen
    mark: str

    def actors(self) -> list[tuple[str, int]]:
        """The kind and id of every process that it has at this moment and that may be killed."""
        processes = processes_with(self.mark)
        return [(kind, process.pid) for kind, part in ACTORS.items() for process in processes if part in process.name]

    def wait(self, timeout_s: float) -> int | None:
        """Its exit code; None where it goes on after `timeout_s`."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self.process.wait(timeout_s)
        return None


@contextlib.contextmanager
def running(job: Path, out: Path) -> Iterator[Run]:
    """A run on two workers; what is left of it in the end is killed."""
    command = [sys.executable, "-m", "services.cli.main", "run", str(job), "--out", str(out), "--workers", "2"]
    settings = {"stdout": subprocess.DEVNULL, "start_new_session": True}
    with open(out.with_suffix(".txt"), "ab") as said, marked(command, stderr=said, **settings) as run:
        yield Run(*run)


def decided(out: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of each commit record: another value means that it was written again."""
    stats = {path.name: path.stat() for path in out.glob("manifest/_commits/*.json")}
    return {name: (stat.st_ino, stat.st_mtime_ns) for name, stat in stats.items()}


def finish_once(job: Path, out: Path) -> tuple[str, float]:
    begun = time.monotonic()
    with running(job, out) as run:
        assert run.wait(400) == 0, out.with_suffix(".txt").read_text()[-2000:]
    return json.loads((out / "_SUCCESS").read_text())["digest"], time.monotonic() - begun


@pytest.mark.timeout(7200)
def test_runs_killed_at_random_make_one_dataset_and_nothing_twice(tmp_path, request, record_figure):
    wanted = int(os.environ.get("VERSO_TEST_KILLS", KILLS.get(request.config.getoption("--scope"), 0)))
    if not wanted:
        pytest.skip("slow: runs with --ci")
    job = tmp_path / "job.yaml"
    job.write_text(JOB)
    digest, whole_s = finish_once(job, tmp_path / "whole")
    chance = random.Random(wanted)
    kills: Counter[str] = Counter()
    finished = 0
    while kills.total() < wanted:
        out = tmp_path / f"out{finished}"
        for _ in range(min(3, wanted - kills.total())):
            before = decided(out)
            with running(job, out) as run:
                time.sleep(chance.uniform(0.1, 0.9) * whole_s)
                if not (actors := run.actors()):
                    break  # it has ended
                actor, pid = chance.choice(actors)
                send_to([pid], signal.SIGKILL)
                kills[actor] += 1
                assert run.wait(400) is not None, f"a run goes on 400 s after its {actor} was killed"
            assert before.items() <= decided(out).items(), "a commit was written again"
        before = decided(out)
        assert finish_once(job, out)[0] == digest
        assert before.items() <= decided(out).items(), "a commit was written again"
        finished += 1
        print(f"{kills.total()} kills: {dict(kills)}, {finished} datasets, {whole_s:.0f} s a run", flush=True)
    record_figure("runs killed at random", "passed", kills.total())


STOPPED_S = 13.0
"""Longer than the patience of the lock."""


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("actor", ACTORS)
def test_a_run_whose_processes_are_stopped_for_a_while_makes_the_same_dataset(actor, tmp_path):
    job, out = tmp_path / "job.yaml", tmp_path / "out"
    job.write_text(JOB)
    with running(job, out) as run:
        while not decided(out):
            assert run.wait(0.05) is None, out.with_suffix(".txt").read_text()[-2000:]
        before = decided(out)
        stopped = [pid for kind, pid in run.actors() if kind == actor]
        assert stopped
        send_to(stopped, signal.SIGSTOP)
        begun = time.monotonic()
        with running(job, out) as second:
            assert second.wait(400) == 1
        assert "is in use by process" in out.with_suffix(".txt").read_text()
        time.sleep(max(0.0, STOPPED_S - (time.monotonic() - begun)))
        send_to(stopped, signal.SIGCONT)
        code = run.wait(400)
        assert code is not None, "the run goes on 400 s after its processes were stopped"
    print(f"{actor}: {len(stopped)} processes stopped; the run ended with {code}", flush=True)
    assert finish_once(job, out)[0] == finish_once(job, tmp_path / "whole")[0]
    assert before.items() <= decided(out).items(), "a commit was written again"


def send_to(pids: list[int], signal_number: int) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal_number)
