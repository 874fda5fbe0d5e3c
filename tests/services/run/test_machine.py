"""Descendants: found through every generation, ended even where they ignore it, and nobody else."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from services.run.machine import descendants, marked, read_process, send, usable_cores

ROOT = Path(__file__).resolve().parents[3]

FAMILY = """
import json, os, subprocess, sys, time
from services.run.machine import adopt_orphans, descendants, end_descendants
adopt_orphans()
stubborn = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(600)"
orphan = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {stubborn!r}], start_new_session=True)"
children = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) for code in (stubborn, orphan)]
[child.stdout.readline() for child in children]
stopped = subprocess.Popen(["sleep", "600"])
stopped.send_signal(19)
children[1].wait()
found = sorted(process.pid for process in descendants(os.getpid()))
print(json.dumps([found, [process.pid for process in end_descendants()]]))
"""


def test_orphans_in_other_sessions_stopped_and_stubborn_ones_are_ended(tmp_path):
    outsider = subprocess.Popen(["sleep", "600"])
    try:
        begun = time.monotonic()
        done = subprocess.run([sys.executable, "-c", FAMILY], cwd=ROOT, capture_output=True, text=True, check=True)
        found, left = json.loads(done.stdout)
        assert len(found) == 3
        assert left == []
        assert [pid for pid in found if read_process(pid) is not None] == []
        assert outsider.poll() is None
        assert time.monotonic() - begun < 15
    finally:
        outsider.kill()
        outsider.wait()


def test_processes_are_known_by_a_line_of_their_environment():
    child = subprocess.Popen(["sleep", "600"], env={"ONE": "run"})
    try:
        assert [process.pid for process in marked("ONE=run")] == [child.pid]
        assert marked("ONE=ru") == marked("NE=run") == []
    finally:
        child.kill()
        child.wait()


def test_a_process_id_that_was_given_out_again_is_left_alone():
    child = subprocess.Popen(["sleep", "600"])
    try:
        process = read_process(child.pid)
        assert process is not None
        assert [one.pid for one in descendants(os.getpid()) if one.pid == child.pid] == [child.pid]
        stranger = type(process)(process.pid, process.parent, "0", process.state, process.name)
        send(stranger, signal.SIGKILL)
        time.sleep(0.1)
        assert child.poll() is None
        send(process, signal.SIGKILL)
        assert child.wait(10) == -signal.SIGKILL
    finally:
        child.kill()
        child.wait()
    assert read_process(child.pid) is None
    send(process, signal.SIGKILL)  # nothing is there, and nothing happens


def control_groups(tmp_path: Path, membership: str, files: dict[str, str]) -> tuple[Path, Path]:
    """A /proc/self/cgroup and a /sys/fs/cgroup with these files."""
    for name, text in files.items():
        file = tmp_path / "sys" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    (tmp_path / "cgroup").write_text(membership)
    return tmp_path / "cgroup", tmp_path / "sys"


@pytest.fixture(autouse=True)
def sixteen_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)))


@pytest.mark.parametrize(
    ("membership", "files", "cores"),
    [
        ("0::/\n", {"cpu.max": "200000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "50000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 16),
        ("0::/\n", {"cpu.max": "6400000 100000\n"}, 16),
        ("0::/user/job\n", {"user/cpu.max": "300000 100000\n", "user/job/cpu.max": "max 100000\n"}, 3),
        ("3:cpu,cpuacct:/\n", {"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
        ("3:cpu:/docker/abc\n", {"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
        ("3:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 16),
        ("3:cpuset:/\n", {"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 16),
    ],
)
def test_a_containers_quota_is_respected(tmp_path, membership, files, cores):
    assert usable_cores(*control_groups(tmp_path, membership, files)) == cores


def test_without_control_groups_the_schedulers_answer_counts(tmp_path):
    assert usable_cores(tmp_path / "absent", tmp_path) == 16
