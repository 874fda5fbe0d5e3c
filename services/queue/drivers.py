"""Edge: drivers. Ray's job API, where they run, and one attempt at a job as it happens on the cluster's head.

The token of the API is taken from RAY_AUTH_MODE and RAY_AUTH_TOKEN.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

from ray.exceptions import AuthenticationError
from ray.job_submission import JobSubmissionClient

from schemas.errors import InUseError, MachineError, RunError, VersoError, plain_line
from schemas.queue import JobRequest
from services.queue.queue import Queue
from services.queue.supervise import Driver, Drivers

ANSWER_S: Final = 30.0
"""Time for the job API to answer."""


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

    def hand_over(self, submission: str, entrypoint: str, metadata: Mapping[str, str]) -> None:
        """Ray itself refuses a submission id that it knows."""
        with self._explained():
            try:
                self._client.submit_job(entrypoint=entrypoint, submission_id=submission, metadata=dict(metadata))
            except RuntimeError:
                if submission not in self.states():
                    raise

    def stop(self, submission: str) -> None:
        """Ray sends SIGTERM, and SIGKILL three seconds later."""
        with self._explained():
            self._client.stop_job(submission)

    def log(self, submission: str) -> str | None:
        """The file that Ray keeps on the head."""
        with self._explained():
            return self._client.get_job_logs(submission) if submission in self.states() else None

    @cached_property
    def _client(self) -> "_PatientClient":
        """A client; Ray's own asks for the version first, and so notices a server that does not answer."""
        return _PatientClient(self._address)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turns what the client raises into a MachineError with one line."""
        try:
            yield
        except AuthenticationError as error:
            raise MachineError(
                f"--address {self._address}: the cluster asks for a token: set RAY_AUTH_MODE=token and its RAY_AUTH_TOKEN "
                "here too"
            ) from error
        except OSError as error:  # what `requests` raises are OSErrors, too
            raise MachineError(
                f"--address {self._address}: Ray's job API does not answer there ({type(error).__name__}): it is the address of "
                "the dashboard, as `ray start --head` prints it"
            ) from error
        except (RuntimeError, ValueError) as error:
            told = plain_line(" ".join(str(error).split()), 300)
            raise MachineError(f"--address {self._address}: Ray's job API refuses: {told}") from error


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
    except InUseError as error:
        queue.append(job, "busy", attempt, note=_note(str(error)))
        raise
    except VersoError as error:
        queue.append(job, "ended", attempt, code=error.exit_code, note=_note(str(error)))
        raise
    queue.append(
        job, "ended", attempt, code=ending.code, note=_note(ending.note), scenes=ending.scenes, digest=ending.digest
    )
    return ending.code


def _note(text: str) -> str:
    return plain_line(" ".join(text.split()), MOST_NOTE)


EVERY_S: Final = 5.0
"""Between two looks."""


class Sharing:
    """Called, it gives the number of jobs that share the cluster; what was read last where storage does not answer."""

    def __init__(self, queue: Queue, clock: Callable[[], float] = time.monotonic) -> None:
        self._queue = queue
        self._clock = clock
        self._jobs = 1
        self._read_at = float("-inf")

    def __call__(self) -> int:
        """At least 1."""
        if self._clock() - self._read_at >= EVERY_S:
            self._read_at = self._clock()
            with contextlib.suppress(VersoError, OSError):
                self._jobs = self._queue.share()
        return self._jobs
