"""Descendants: found through every generation, ended even where they ignore it, and nobody else."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from services.run.machine import descendants, marked, read_process, send

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
