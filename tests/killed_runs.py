"""Runs whose processes are killed or interrupted while they work."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


@contextlib.contextmanager
def deadly_scene(out: Path, scene_id: int) -> Iterator[list[int]]:
    """While this lasts, whichever process begins the scene is killed; yields the pids."""
    killed: list[int] = []
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.002):
            with contextlib.suppress(OSError, ValueError):  # folders come and go while we look
                for note in out.glob("_staging/*/*/_current"):
                    pid = int(note.parent.name.split("-")[-2])
                    if pid not in killed and json.loads(note.read_text()).get("scene_id") == scene_id:
                        os.kill(pid, signal.SIGKILL)
                        killed.append(pid)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield killed
    finally:
        over.set()
        watcher.join()


def interrupt_at_first_commit(job: Path, out: Path) -> tuple[subprocess.Popen[str], str]:
    """A run on one worker that gets SIGINT, it and all its processes, when it has committed something; what it said."""
    command = [sys.executable, "-m", "services.cli.main", "run", str(job), "--out", str(out), "--shard-size", "4"]
    run = subprocess.Popen(
        [*command, "--workers", "1"], cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while not list(out.glob("manifest/_commits/*.json")) and run.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    if run.poll() is None:
        os.killpg(run.pid, signal.SIGINT)
    _, told = run.communicate(timeout=60)
    return run, told


def processes_of(session: int) -> list[str]:
    """Command lines of what still runs in a session."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            after_name = stat.read_text().rpartition(")")[2].split()
            if int(after_name[3]) == session and after_name[0] != "Z":
                found.append((stat.parent / "cmdline").read_text())
    return found
