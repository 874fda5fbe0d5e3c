"""Edge: drivers. Ray's job API, one attempt at a job as it happens on the cluster's head, and the drivers of one machine.

The token of the API is taken from RAY_AUTH_MODE and RAY_AUTH_TOKEN. On one machine drivers are children of the supervisor, and
work on a private Ray that ends with it. That Ray is the one of `verso run`: it listens on loopback, asks for a token that no
file holds, and has no job API. The drivers get its address and token in their environment. What they write lies in its folder,
where `verso logs` finds it.
"""

import contextlib
import json
import logging
import os
import shlex
import signal
import socket
import subprocess
import time
import urllib.parse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from ray.exceptions import AuthenticationError
from ray.job_submission import JobSubmissionClient

from schemas.errors import InputError, InUseError, MachineError, RunError, VersoError, plain_line
from schemas.queue import JobRequest
from services.queue.queue import Queue
from services.queue.supervise import Driver, Drivers
from services.run.machine import living_folders, private_folder, usable_cores
from services.run.ray_cluster import address_here, ray_in
from services.run.supervisor import STOP_S

ANSWER_S: Final = 30.0
"""Time for the job API to answer."""

STARTING: Final = "No available agent"
"""What Ray says while a head that was just started takes no jobs yet."""

STARTS_S: Final = 90.0
"""The time for which it may say so."""


class _PatientClient(JobSubmissionClient):
    """Ray's client, which waits for ever otherwise."""

    def _do_request(self, *arguments: Any, **settings: Any) -> Any:
        return super()._do_request(*arguments, timeout=ANSWER_S, **settings)


class RayDrivers(Drivers):
    """The job API at an HTTP address."""

    def __init__(self, address: str) -> None:
        self._address = address

    def states(self) -> dict[str, Driver]:
        """From one listing of all jobs."""
        with self._explained():
            return {
                job.submission_id: Driver("over" if job.status.is_terminal() else "running", _first_line(job.message))
                for job in self._client.list_jobs()
                if job.submission_id
            }

    def require(self, submission: str) -> None:
        """Raises InputError where the cluster does not know a driver."""
        if submission not in self.states():
            raise InputError(f"--address {self._address}: the cluster has no job {plain_line(submission)}")

    def hand_over(self, submission: str, words: Sequence[str]) -> None:
        """Ray itself refuses a submission id that it knows; a head that has just started is asked again."""
        # Ray's supervisor gives this line to a shell: quoted, every word arrives as it is.
        entrypoint, deadline = shlex.join(words), time.monotonic() + STARTS_S
        with self._explained():
            while True:
                try:
                    self._client.submit_job(entrypoint=entrypoint, submission_id=submission)
                    return
                except RuntimeError as error:
                    if STARTING not in str(error) or time.monotonic() > deadline:
                        if submission in self.states():
                            return
                        raise
                time.sleep(1.0)

    def stop(self, submission: str) -> None:
        """Ray sends SIGTERM, and SIGKILL three seconds later."""
        with self._explained():
            self._client.stop_job(submission)

    def log(self, submission: str) -> str | None:
        """The file that Ray keeps on the head."""
        with self._explained():
            return self._client.get_job_logs(submission) if submission in self.states() else None

    def close(self) -> bool:
        """Drivers of a cluster go on."""
        return False

    def end_of(self, submission: str) -> tuple[int | None, str]:
        """The exit code of a driver that is over, None where it has none, and Ray's words."""
        with self._explained():
            job = self._client.get_job_info(submission)
        if job.status == "STOPPED":
            return None, "it was stopped"
        return (0 if job.status == "SUCCEEDED" else job.driver_exit_code), _first_line(job.message)

    @cached_property
    def _client(self) -> "_PatientClient":
        """A client; Ray's own asks for the version first, and so notices a server that does not answer."""
        logging.getLogger("ray.dashboard.modules.job.sdk").setLevel(logging.WARNING)  # else it tells of its sockets
        return _PatientClient(self._address)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turns what the client raises into a MachineError with one line."""
        try:
            yield
        except (AuthenticationError, OSError, RuntimeError, ValueError) as error:
            words = f"Ray's job API refuses: {plain_line(' '.join(str(error).split()), 300)}"
            if isinstance(error, AuthenticationError):
                words = "the cluster asks for a token: set RAY_AUTH_MODE=token and its RAY_AUTH_TOKEN here too"
            elif isinstance(error, OSError):  # as what `requests` raises
                remedy = "it is the address of the dashboard, as `ray start --head` prints it"
                words = f"Ray's job API does not answer there ({type(error).__name__}): {remedy}"
            raise MachineError(f"--address {self._address}: {words}") from error


def _first_line(text: str | None) -> str:
    """Ray's words, without the end of the log that it adds to them."""
    first = next(iter((text or "").splitlines()), "")
    return plain_line(first.partition(", last available logs")[0].rstrip(".: "), 200)


MOST_NOTE = 900
"""Characters of an error that a job's events keep."""


@dataclass(frozen=True)
class Ending:
    """How a command ended by itself."""

    code: int
    note: str = ""
    scenes: int | None = None
    digest: str | None = None


def drive(queue: Queue, job: str, attempt: int, work: Callable[[JobRequest], Ending]) -> int:
    """The exit code of one attempt. Raises RunError where it is not this driver's turn, and what `work` raises.

    What ends without a word (a kill, a lost Ray, a signal) tells nothing here, and so counts as a death.
    """
    view = queue.append(job, "began", attempt)
    if view is None:
        now = queue.read(job)
        raise RunError(
            f"job {job} is {now.state}, at attempt {now.attempt}: there is nothing to do for attempt {attempt}"
        )
    try:
        ending = work(view.request)
    except VersoError as error:
        note = plain_line(" ".join(str(error).split()), MOST_NOTE)
        end = {"kind": "busy"} if isinstance(error, InUseError) else {"kind": "ended", "code": error.exit_code}
        queue.append(job, attempt=attempt, note=note, **end)
        raise
    queue.append(job, "ended", attempt, **asdict(ending))
    return ending.code


EVERY_S: Final = 5.0
"""Between two looks."""


def sharing_of(queue: Queue, clock: Callable[[], float] = time.monotonic) -> Callable[[], int]:
    """What tells how many jobs share the cluster, at least 1; what was read last where storage does not answer."""
    jobs, read_at = 1, float("-inf")

    def count() -> int:
        nonlocal jobs, read_at
        if clock() - read_at >= EVERY_S:
            read_at = clock()
            with contextlib.suppress(VersoError, OSError):
                jobs = queue.share()
        return jobs

    return count


FOLDER: Final = "drivers"
NOTE: Final = "supervisor.json"

CONNECT_S: Final = 2.0


def answers(http: str) -> bool:
    """Whether anything accepts a connection there."""
    place = urllib.parse.urlsplit(http)
    with contextlib.suppress(OSError), socket.create_connection((place.hostname or "", place.port or 80), CONNECT_S):
        return True
    return False


class OwnDrivers(Drivers):
    """Drivers that are children of this process, with their logs in `folder`."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._environment = dict(environment)
        self._known: dict[str, subprocess.Popen[bytes]] = {}
        self._stopped: set[str] = set()

    def states(self) -> dict[str, Driver]:
        """Of the drivers that this process started."""
        return {
            submission: Driver("running") if process.poll() is None else Driver("over", _end_of(process.returncode))
            for submission, process in self._known.items()
        }

    def hand_over(self, submission: str, words: Sequence[str]) -> None:
        """Starts the process. Raises MachineError where the program cannot be started."""
        if submission in self._known:
            return
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

    def close(self) -> bool:
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
        return True


def _end_of(code: int) -> str:
    return f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"


def _read_log(folder: Path, submission: str) -> str | None:
    try:
        return (folder / f"{submission}.txt").read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return None


class LogsHere(RayDrivers):
    """Ray's job API, and before it the logs of this user's drivers on this machine."""

    def log(self, submission: str) -> str | None:
        """Of a driver of either kind."""
        for folder in living_folders():
            if (text := _read_log(folder / FOLDER, submission)) is not None:
                return text
        return super().log(submission)


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


def _refuse_second(mine: Path) -> None:
    """Raises RunError where the queue of another process has a Ray of its own here: both would use every core."""
    for folder in living_folders():
        with contextlib.suppress(OSError, ValueError):
            if folder != mine:
                other = json.loads((folder / FOLDER / NOTE).read_bytes())
                raise RunError(
                    f"process {other['pid']} works here with a Ray of its own, for the queue {other['queue']}: submit jobs there "
                    "(`verso submit --queue`), or end it first"
                )
