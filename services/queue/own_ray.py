"""Edge: a queue of one machine. Drivers are children of the supervisor, and work on a private Ray that ends with it.

That Ray is the one of `verso run`: it listens on loopback, asks for a token that no file holds, and has no job API. The drivers
get its address and token in their environment. What they write lies in its folder, where `verso logs` finds it.
"""

import contextlib
import json
import os
import shlex
import signal
import socket
import subprocess
import time
import urllib.parse
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from schemas.errors import MachineError, RunError
from services.queue.drivers import RayDrivers
from services.queue.supervise import Driver, EndingDrivers
from services.run.machine import usable_cores
from services.run.ray_cluster import address_here, living_folders, private_folder, ray_in
from services.run.supervisor import STOP_S

FOLDER: Final = "drivers"
NOTE: Final = "supervisor.json"

CONNECT_S: Final = 2.0


def answers(http: str) -> bool:
    """Whether anything accepts a connection there."""
    place = urllib.parse.urlsplit(http)
    try:
        socket.create_connection((place.hostname or "", place.port or 80), timeout=CONNECT_S).close()
    except OSError:
        return False
    return True


class OwnDrivers(EndingDrivers):
    """Drivers that are children of this process, with their logs in `folder`."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._environment = dict(environment)
        self._known: dict[str, subprocess.Popen[bytes]] = {}
        self._stopped: set[str] = set()

    def states(self) -> dict[str, Driver]:
        """Of the drivers that this process started."""
        return {submission: _state_of(process.poll()) for submission, process in self._known.items()}

    def hand_over(self, submission: str, entrypoint: str, metadata: Mapping[str, str]) -> None:
        """Starts the process. Raises MachineError where the program cannot be started."""
        if submission in self._known:
            return
        words = shlex.split(entrypoint)
        with (self._folder / f"{submission}.txt").open("wb") as log:
            try:
                self._known[submission] = subprocess.Popen(
                    words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=self._environment
                )
            except OSError as error:
                raise MachineError(f"--driver {words[0]}: it cannot be started ({error.strerror})") from error

    def stop(self, submission: str) -> None:
        """SIGTERM, once: at a second one a driver ends without order."""
        if submission not in self._stopped:
            self._stopped.add(submission)
            self._known[submission].terminate()

    def log(self, submission: str) -> str | None:
        """What lies in the folder."""
        return _read_log(self._folder, submission)

    def end(self) -> None:
        """Stops all drivers and waits for their ends."""
        for submission, driver in self.states().items():
            if driver.state == "running":
                self.stop(submission)
        deadline = time.monotonic() + STOP_S
        for process in self._known.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _state_of(code: int | None) -> Driver:
    if code is None:
        return Driver("running")
    return Driver("over", f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}")


def _read_log(folder: Path, submission: str) -> str | None:
    try:
        return (folder / f"{submission}.txt").read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return None


class LogsHere(RayDrivers):
    """Ray's job API, and before it the logs of this user's drivers on this machine."""

    def log(self, submission: str) -> str | None:
        """Of a driver of either kind."""
        found = (_read_log(folder / FOLDER, submission) for folder in living_folders())
        here = next((text for text in found if text is not None), None)
        return super().log(submission) if here is None else here


@contextlib.contextmanager
def own_ray(queue: str, say: Callable[[str], None]) -> Iterator[OwnDrivers]:
    """Drivers on a private Ray with a slot for each usable core; both have ended when the block has.

    Raises RunError where another queue has one on this machine, for this user, and MachineError where Ray does not start.
    """
    cores = usable_cores()
    with private_folder() as folder:
        logs = folder / FOLDER
        logs.mkdir()
        (logs / NOTE).write_text(json.dumps({"queue": queue, "pid": os.getpid()}), encoding="utf-8")
        _refuse_second(folder)
        with ray_in(folder, cores):
            environ = dict(os.environ)  # noqa: TID251 - drivers get this process's, with the token in it
            drivers = OwnDrivers(logs, environ | {"RAY_ADDRESS": address_here()})
            say(
                f"no Ray answers on this machine: jobs run on one of its own, with {cores} workers, that ends with this command"
            )
            yield drivers


def _refuse_second(own: Path) -> None:
    """Raises RunError where the queue of another process has a Ray of its own here: both would use every core."""
    for folder in living_folders():
        with contextlib.suppress(OSError, ValueError):
            if folder != own:
                other = json.loads((folder / FOLDER / NOTE).read_bytes())
                raise RunError(
                    f"process {other['pid']} works here with a Ray of its own, for the queue {other['queue']}: submit jobs there "
                    "(`verso submit --queue`), or end it first"
                )
