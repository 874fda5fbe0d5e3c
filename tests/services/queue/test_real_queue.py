"""Three jobs on a real Ray head: one cancelled, one whose driver is killed, one that waits; supervisors are killed too."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from services.job.job_file import load_job
from services.queue.queue import open_queue
from services.run.lock import read_holder
from tests.datasets import run_here
from tests.kit.killed_runs import processes_with, wait_for
from tests.kit.ray_head import ROOT, BareCluster, bare_cluster

TABLETOP = ROOT / "deploy" / "jobs" / "tabletop.yaml"
SCENES, MANY = 4, 4000
SLOWLY = [*("--set", "run.range_size=1"), *("--set", "run.shard_size=1"), *("--set", "run.workers=1")]
"""Commits come one by one, and of many scenes there is always one to come."""
HOSTILE = "o $(touch x) `touch x`; touch x 'y' \"z\""


@contextlib.contextmanager
def supervisor(head: BareCluster, queue: str, log: Path) -> Iterator[subprocess.Popen]:
    """`verso supervise` as a process; killed with -9 in the end, if it lives."""
    command = [
        sys.executable,
        "-P",
        "-m",
        "services.cli.main",
        "supervise",
        "--queue",
        queue,
        "--address",
        head.dashboard,
    ]
    command += ["--driver", str(log.with_name("driver"))]
    with log.open("ab") as words:
        process = subprocess.Popen(command, cwd=ROOT, env=head.shell, stdout=words, stderr=words)
    try:
        wait_for(lambda: is_at_work(queue, process), log.read_text)
        yield process
    finally:
        process.kill()
        process.wait()


def is_at_work(queue: str, process: subprocess.Popen) -> bool:
    holder = read_holder(open_queue(queue).store)
    return process.poll() is None and holder is not None and holder.pid == process.pid


def kill_driver(head: BareCluster, job: str) -> None:
    """Kills the innermost process of a job's `verso drive`, the one that gives work to Ray."""
    ours = [process.pid for process in processes_with(head.mark) if f" drive {job} " in process.name]
    threads = {pid: len(list(Path(f"/proc/{pid}/task").iterdir())) for pid in ours}
    driver = max(threads, key=lambda pid: threads[pid])
    assert threads[driver] > 5  # those of Ray; its supervisors have none
    os.kill(driver, signal.SIGKILL)


DRIVER = """#!{python}
import sys, time
from pathlib import Path
from services.cli.main import main
from services.run import run_job

def end_when_told(*arguments, work=run_job.make_missing):
    made = work(*arguments)
    while not Path({gate!r}).exists():
        time.sleep(0.05)
    return made

run_job.make_missing = end_when_told
sys.exit(main())
"""
"""`verso` on the head, whose jobs stay in Ray until the gate is there: however slow the machine, they can be killed."""


@pytest.mark.ray
@pytest.mark.minute
@pytest.mark.timeout(600)
def test_three_jobs_of_which_one_is_cancelled_one_killed_and_one_waits(tmp_path):
    _, digest = run_here(load_job(TABLETOP, [f"scenes={SCENES}"]), tmp_path / "alone")
    queue, log, gate = str(tmp_path / "queue"), tmp_path / "supervisor.log", tmp_path / "gate"
    (tmp_path / "driver").write_text(DRIVER.format(python=sys.executable, gate=str(gate)))
    (tmp_path / "driver").chmod(0o755)

    with bare_cluster(dashboard=True) as head:

        def submit(out: str, priority: int, scenes: int) -> str:
            words = ["--out", str(tmp_path / out), "--priority", str(priority), "--scenes", str(scenes), *SLOWLY]
            done = head.verso("submit", str(TABLETOP), *words, VERSO_QUEUE=queue)
            assert "no supervisor is running" in done.stderr
            return done.stdout.strip()

        def rows() -> dict[str, dict[str, Any]]:
            told = head.verso("jobs", "--queue", queue, "--json").stdout
            return {row["id"]: row for row in json.loads(told.splitlines()[-1])["jobs"]}

        waiting, cancelled, killed = (
            submit(HOSTILE, 0, SCENES),
            submit("cancelled", 3, MANY),
            submit("killed", 5, SCENES),
        )
        assert {job: (row["state"], row["scenes_asked"]) for job, row in rows().items()} == {
            killed: ("queued", SCENES),
            cancelled: ("queued", MANY),
            waiting: ("queued", SCENES),
        }
        read = open_queue(queue).read

        refused = head.verso("supervise", "--queue", queue, "--address", head.dashboard, RAY_AUTH_TOKEN="b" * 64)
        assert (refused.returncode, refused.stderr.count("\n")) == (1, 1)
        assert "RAY_AUTH_TOKEN" in refused.stderr

        def commits(job: str) -> int:
            return len(list(Path(read(job).request.out).glob("manifest/_commits/*")))

        with supervisor(head, queue, log) as first:
            for job in (killed, cancelled):
                wait_for(lambda job=job: commits(job), log.read_text)
            first.kill()
            kill_driver(head, killed)
            gate.touch()
            before = commits(cancelled)
            wait_for(lambda: commits(cancelled) > before, log.read_text)
            assert read(waiting).state == "queued"  # although it is the oldest
        told = head.verso("cancel", cancelled, "--queue", queue)
        assert (told.returncode, told.stdout) == (0, f"{cancelled}: cancelling\n")

        with supervisor(head, queue, log) as second:
            again = head.verso("supervise", "--queue", queue, "--address", head.dashboard)
            assert again.returncode == 1 and "another supervisor works here" in again.stderr
            wait_for(lambda: all(read(job).ended for job in (killed, cancelled, waiting)), log.read_text)
            wait_for(lambda: open_queue(queue).has_log(killed, 2), log.read_text)
            second.terminate()
            assert second.wait(60) == 0
            assert read_holder(open_queue(queue).store) is None
        found = rows()
        kept = found[cancelled].pop("scenes_done")
        assert 0 < kept < MANY
        assert {job: (row["state"], row["attempts"]) for job, row in found.items()} == {
            killed: ("done", 2),
            cancelled: ("cancelled", 1),
            waiting: ("done", 1),
        }
        assert (found[killed]["digest"], found[waiting]["digest"]) == (digest, digest)
        assert (found[killed]["scenes_done"], found[waiting]["scenes_done"]) == (SCENES, SCENES)
        assert not [one for one in processes_with(head.mark) if " drive " in one.name]
    logs = head.verso("logs", killed, "--queue", queue, "--address", head.dashboard)  # the cluster is gone
    assert logs.stdout.index("--- attempt 1 ---") < logs.stdout.index("--- attempt 2 ---")
    assert f"dataset digest {digest}" in logs.stdout
    assert not list(tmp_path.rglob("x")) and not (ROOT / "x").exists()
