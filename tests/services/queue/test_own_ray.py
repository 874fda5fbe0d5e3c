"""A queue of one machine, its own Ray and every end of both; and three jobs on a real Ray head: one cancelled, one whose driver
is killed, one that waits, while supervisors are killed too.
"""

import contextlib
import http.server
import json
import os
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from schemas.errors import MachineError, RunError
from services.cli import rows
from services.cli.main import main
from services.job.job_file import load_job
from services.queue import drivers as module
from services.queue.drivers import LogsHere, OwnDrivers, answers, own_ray
from services.queue.queue import open_queue
from services.queue.supervise import Driver, Rules, supervise
from services.run.lock import read_holder
from services.run.machine import private_folder
from tests.datasets import run_here
from tests.kit.killed_runs import chain_of, processes_with, wait_for
from tests.kit.network import free_port, listeners_of
from tests.kit.queue_world import ids, queue_of, request_of
from tests.kit.ray_head import ROOT, BareCluster, bare_cluster

TABLETOP = ROOT / "deploy" / "jobs" / "tabletop.yaml"


def test_drivers_are_children_that_are_told_once_to_end_and_whose_logs_are_found_while_they_run(monkeypatch):
    with private_folder() as folder:
        logs = folder / module.FOLDER
        logs.mkdir()
        drivers = OwnDrivers(logs, {**os.environ, "GIVEN": "to drivers"})
        stubborn = "trap 'echo told' TERM; echo $GIVEN; for ((i = 0; i < 600; i++)); do sleep 0.05; done"
        for name, script in {"stubborn": stubborn, "plain": "exit 3", "killed": "kill -9 $$"}.items():
            for _ in range(2):  # a driver that is known is not started again
                drivers.hand_over(name, ["bash", "-c", script])
        wait_for(lambda: [one.state for one in drivers.states().values()].count("over") == 2)
        assert drivers.states() == {
            "stubborn": Driver("running"),
            "plain": Driver("over", "exit code 3"),
            "killed": Driver("over", "killed by SIGKILL"),
        }
        reader = LogsHere("http://127.0.0.1:1")
        wait_for(lambda: reader.log("stubborn") == "to drivers\n")
        for _ in range(3):
            drivers.stop("stubborn")
            time.sleep(0.2)
        assert drivers.log("stubborn") == "to drivers\ntold\n" and reader.log("plain") == ""
        with pytest.raises(MachineError, match=r"--driver /no/verso: it cannot be started \(No such file"):
            drivers.hand_over("other", ["/no/verso", "drive"])
        monkeypatch.setattr(module, "STOP_S", 0.2)
        assert drivers.close()
        assert drivers.states()["stubborn"] == Driver("over", "killed by SIGKILL")
    with pytest.raises(MachineError, match=r"--address http://127\.0\.0\.1:1"):
        reader.log("stubborn")


def test_an_orderly_end_is_no_death_of_a_job_and_of_a_cancelled_one_the_end(tmp_path, monkeypatch):
    (job, cancelled), said = ids(2), []
    queue = queue_of(tmp_path / "q", request_of(job), request_of(cancelled))

    def interrupt(seconds: float) -> None:
        monkeypatch.undo()
        queue.append(job, "began", 1)
        queue.append(cancelled, "cancel")
        raise KeyboardInterrupt

    class Slow(OwnDrivers):
        def __enter__(self):
            return self

        def __exit__(self, *_):
            assert set(self.states().values()) == {Driver("over", "killed by SIGTERM")}

    monkeypatch.setattr("services.queue.supervise.time.sleep", interrupt)
    rules = Rules(2, [sys.executable, "-c", "import time; time.sleep(600)"])
    with pytest.raises(KeyboardInterrupt):
        supervise(queue, Slow(tmp_path, os.environ), rules, said.append)
    view = queue.read(job)
    assert (view.state, view.deaths, view.attempt) == ("queued", 0, 1)
    assert queue.read(cancelled).state == "cancelled"
    assert queue.has_log(job, 1)


def test_a_second_one_and_a_machine_without_memory_are_told_in_one_line(tmp_path, monkeypatch):
    def no_memory(**_: Any) -> None:
        raise ValueError("only 0.01 GB is left for tasks\nThe rest of the words")

    monkeypatch.setattr("ray.init", no_memory)
    told = r"Ray did not start on this machine \(only 0.01 GB is left for tasks\)"
    with pytest.raises(MachineError, match=told), own_ray("/first", print):
        pass
    with private_folder() as other:
        (other / module.FOLDER).mkdir()
        (other / module.FOLDER / module.NOTE).write_text(json.dumps({"queue": "/first", "pid": 7}))
        told = "process 7 works here with a Ray of its own, for the queue /first: submit"
        with pytest.raises(RunError, match=told), own_ray("/second", print):
            pass


def test_a_port_that_something_else_uses_is_told_with_the_way_round_it(tmp_path, monkeypatch, capsys):
    handler = type("Other", (http.server.BaseHTTPRequestHandler,), {"log_message": lambda *_: None})
    with http.server.HTTPServer(("127.0.0.1", 0), handler) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        monkeypatch.setattr(rows, "DASHBOARD", f"http://127.0.0.1:{other.server_port}")
        code = main(["supervise", "--queue", str(tmp_path / "q")])
        other.shutdown()
    told = capsys.readouterr().err
    assert code == 1 and told.count("\n") == 1
    assert told.startswith(f"verso: --address {rows.DASHBOARD}: Ray's job API")
    assert told.endswith("or give the queue a Ray of its own on this machine: --address own\n")
    assert not answers(rows.DASHBOARD)


# ------------------------------------------------------------------------------------------------ with a real Ray


class Machine:
    """One on which nothing answers at the default address; `mark` is in the environment of all that is started here."""

    def __init__(self, folder: Path) -> None:
        self.queue, self.log = str(folder / "queue"), folder / "log"
        self.mark = f"VERSO_TEST_MARK={uuid.uuid4().hex}"
        self._environment = {**os.environ, **dict([self.mark.split("=")]), "VERSO_QUEUE": self.queue, "TMPDIR": "/tmp"}
        start = f"import sys; from services.cli import main, rows; rows.DASHBOARD = 'http://127.0.0.1:{free_port()}'; "
        self._command = [sys.executable, "-c", f"{start}sys.exit(main.main())"]

    def verso(self, *words: str) -> "subprocess.CompletedProcess[str]":
        command = [*self._command, *words]
        return subprocess.run(command, cwd=ROOT, env=self._environment, capture_output=True, text=True, check=False)

    def supervisor(self) -> subprocess.Popen:
        with self.log.open("ab") as words:
            command = [*self._command, "supervise", "--at-once", "1"]
            return subprocess.Popen(command, cwd=ROOT, env=self._environment, stdout=words, stderr=words)

    def submit(self, out: Path, scenes: int) -> str:
        slowly = [*("--set", "run.range_size=1"), *("--set", "run.shard_size=1")]
        done = self.verso("submit", str(TABLETOP), "--out", str(out), "--scenes", str(scenes), *slowly)
        return done.stdout.strip()

    def left(self) -> list[str]:
        return [process.name for process in processes_with(self.mark)]


def folders() -> set[Path]:
    return set(Path("/tmp").glob("vr-*"))


ENDS = ([signal.SIGKILL] * 3, [signal.SIGINT], [signal.SIGHUP])
"""What is sent to the supervisor, its keeper and its driver, one after the other; it is ended by SIGTERM last."""


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("ends", [ENDS[:1], ENDS[1:]], ids=["a kill", "the rest"])
def test_submit_and_supervise_are_the_whole_queue_of_one_machine_and_every_end_leaves_nothing(ends, tmp_path):
    _, digest = run_here(load_job(TABLETOP, ["scenes=4"]), tmp_path / "alone")
    machine, before = Machine(tmp_path), folders()
    short, long = machine.submit(tmp_path / "short", 4), machine.submit(tmp_path / "long", 4000)
    read, log = open_queue(machine.queue).read, machine.log
    supervisor = machine.supervisor()
    try:
        wait_for(lambda: read(short).state == "done", log.read_text)
        assert read(short).digest == digest
        wait_for(lambda: list((tmp_path / "long").glob("manifest/_commits/*")), log.read_text)
        assert "4000 scenes" in machine.verso("logs", long).stdout, "of a driver that runs"
        assert {one.address for one in listeners_of(supervisor.pid) if one.protocol.startswith("tcp")} <= {"127.0.0.1"}
        told = machine.verso("supervise", "--queue", str(tmp_path / "other")).stderr
        assert f"for the queue {machine.queue}: submit jobs there" in told and told.count("\n") == 1
        assert "another supervisor works here" in machine.verso("supervise").stderr
        deaths = 0
        for signals in ends:
            for pid, number in zip(chain_of(supervisor.pid), signals, strict=False):
                os.kill(pid, number)
            code = supervisor.wait(60)
            wait_for(lambda: not machine.left(), lambda: str(machine.left()))
            assert folders() <= before
            orderly = signals[0] != signal.SIGKILL
            assert (code == 0) == orderly
            assert read(long).state == ("queued" if orderly else "running"), log.read_text()
            supervisor = machine.supervisor()
            attempt, deaths = read(long).attempt, deaths + (not orderly)
            wait_for(lambda n=attempt: read(long).began and read(long).attempt > n, log.read_text)
            assert read(long).deaths == deaths
        machine.verso("cancel", long)
        wait_for(lambda: read(long).state == "cancelled", log.read_text)
    finally:
        supervisor.terminate()
        supervisor.wait()
    said = log.read_text()
    assert "a Ray of its own" not in said and said.count("no Ray answers on this machine") == 1 + len(ends)


# ---------------------------------------------------------------------------------------------- a Ray head

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
            told = head.verso("jobs", "--queue", queue, "--json")
            assert told.returncode == 0, told.stderr
            return {row["id"]: row for row in json.loads(told.stdout.splitlines()[-1])["jobs"]}

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
        wait_for(
            lambda: not [one for one in processes_with(head.mark) if " drive " in one.name]
        )  # one may just be ending
    logs = head.verso("logs", killed, "--queue", queue, "--address", head.dashboard)  # the cluster is gone
    assert logs.stdout.index("--- attempt 1 ---") < logs.stdout.index("--- attempt 2 ---")
    assert f"dataset digest {digest}" in logs.stdout
    assert not list(tmp_path.rglob("x")) and not (ROOT / "x").exists()
