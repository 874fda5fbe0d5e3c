"""Runs whose processes are killed or interrupted while they work."""

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from services.run.machine import Process, descendants, read_process, send

ROOT = Path(__file__).resolve().parents[2]


def deadly_scene(out: Path, scene_id: int) -> contextlib.AbstractContextManager[list[int]]:
    """While this lasts, whichever process begins the scene is killed; yields the pids."""
    return disturbed_scene(out, scene_id, signal.SIGKILL)


@contextlib.contextmanager
def disturbed_scene(out: Path, scene_id: int | None, number: int, most: int = 1000) -> Iterator[list[int]]:
    """While this lasts, whichever process begins the scene (None: commits) gets the signal, at most `most` of them.

    Yields their pids.
    """
    disturbed: list[int] = []
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.002):
            with contextlib.suppress(OSError, ValueError):  # folders come and go while we look
                for note in out.glob("_staging/*/*/_current"):
                    pid = int(note.parent.name.split("-")[-2])
                    new = pid not in disturbed and len(disturbed) < most
                    if new and json.loads(note.read_text()).get("scene_id") == scene_id:
                        os.kill(pid, number)
                        disturbed.append(pid)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield disturbed
    finally:
        over.set()
        watcher.join()


IN_TERMINAL = """
import os, signal, sys
os.setsid()
os.close(os.open(os.ttyname(0), os.O_RDWR))  # becomes the controlling terminal
signal.signal(signal.SIGINT, signal.SIG_DFL)  # also where the tests were started in the background
os.execv(sys.argv[1], sys.argv[1:])
"""


@dataclass(frozen=True)
class EndedRun:
    """A `verso run` that was disturbed: its exit code, what it said, and command lines of what it left running."""

    code: int
    told: str
    left: list[str]


@contextlib.contextmanager
def marked(command: list[str], **settings: Any) -> Iterator[tuple[subprocess.Popen, str]]:
    """A process, and the mark in its environment by which what it started is known; what is left in the end is killed."""
    mark = f"VERSO_TEST_MARK={uuid.uuid4().hex}"
    process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, **dict([mark.split("=")])}, **settings)
    try:
        yield process, mark
    finally:
        process.kill()
        process.wait()
        for left in processes_with(mark):
            with contextlib.suppress(ProcessLookupError):
                os.kill(left.pid, signal.SIGKILL)


def disturb_at_first_commit(job: Path, out: Path, disturb: Callable[[int, int], object]) -> EndedRun:
    """A run on one worker in a terminal of its own; once something is committed, `disturb(pid, terminal)` is called."""
    command = [sys.executable, "-m", "services.cli.main", "run", str(job), "--out", str(out), "--shard-size", "4"]
    terminal, users_end = pty.openpty()
    said: list[bytes] = []
    reader = threading.Thread(target=_read_terminal, args=(terminal, said))
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), users_end)
    with marked([sys.executable, "-c", IN_TERMINAL, *command, "--workers", "1"], **streams) as (run, mark):
        os.close(users_end)
        reader.start()
        deadline = time.monotonic() + 120
        while not list(out.glob("manifest/_commits/*.json")) and run.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        disturb(run.pid, terminal)
        run.wait(90)
        left = [process.name for process in processes_with(mark)]
    reader.join(10)
    os.close(terminal)
    return EndedRun(run.returncode, b"".join(said).decode(errors="replace"), left)


HOLD = """
import sys, time
from services.run.lock import hold_lock
from workers.store.local import LocalStore
with hold_lock(LocalStore(sys.argv[1])):
    print(flush=True)
    time.sleep(600)
"""


@contextlib.contextmanager
def holding(folder: Path) -> Iterator[subprocess.Popen]:
    """A process that holds the lock of an output folder; killed in the end."""
    command = [sys.executable, "-c", HOLD, str(folder)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


PATIENCE_S = 180.0


def wait_for(happened: Callable[[], Any], told: Callable[[], str] = str) -> Any:
    """What `happened` answers once that is true; fails with what is `told` after `PATIENCE_S`."""
    deadline = time.monotonic() + PATIENCE_S
    while not (answer := happened()):
        assert time.monotonic() < deadline, told()
        time.sleep(0.05)
    return answer


def interrupt(pid: int, terminal: int) -> None:
    """Ctrl-C: the terminal sends SIGINT to its foreground process group."""
    os.write(terminal, b"\x03")


def chain_of(pid: int) -> list[int]:
    """Process ids of a supervised command at work: its own, its keeper's, its driver's (the one with children)."""
    below = descendants(pid)
    parents = {process.parent for process in below}
    return [pid, below[0].pid, *(one.pid for one in below if one.parent == below[0].pid and one.pid in parents)]


def kill_processes(title: str, number: int) -> Callable[[int, int], None]:
    """Sends a signal to those below the run whose command line begins with, or whose program ends in, `title`."""

    def disturb(pid: int, terminal: int) -> None:
        lines = {process: _command_line(process.pid) for process in descendants(pid)}
        matching = [p for p, line in lines.items() if line.startswith(title) or line.partition(" ")[0].endswith(title)]
        assert matching, title
        for process in matching:
            send(process, number)

    return disturb


def processes_with(mark: str) -> list[Process]:
    """Processes that have `mark` in their environment; their names are their command lines."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            process = read_process(int(folder.name))
            if process and not process.ended and mark.encode() in (folder / "environ").read_bytes().split(b"\0"):
                found.append(replace(process, name=_command_line(process.pid)))
    return found


def _command_line(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    return ""


def _read_terminal(terminal: int, said: list[bytes]) -> None:
    with contextlib.suppress(OSError):  # Linux ends a terminal that nobody has open by an error
        while part := os.read(terminal, 2**16):
            said.append(part)
