"""Edge: Ray's job API, where the drivers of a queue's jobs run. The token is taken from RAY_AUTH_MODE and RAY_AUTH_TOKEN."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, Final, Protocol

from ray.exceptions import AuthenticationError
from ray.job_submission import JobSubmissionClient

from schemas.errors import MachineError, plain_line
from services.queue.decide import Driver

ANSWER_S: Final = 30.0
"""Time for the job API to answer."""


class Drivers(Protocol):
    """Where drivers run. Every method raises MachineError where it does not answer."""

    def states(self) -> dict[str, Driver]:
        """By submission id: the drivers that are known."""

    def hand_over(self, submission: str, entrypoint: str, metadata: Mapping[str, str]) -> None:
        """Starts a driver, unless one of this submission id is known already."""

    def stop(self, submission: str) -> None:
        """Asks for the end of a driver; returns at once."""

    def log(self, submission: str) -> str | None:
        """What a driver and its commands wrote so far; None where it is not known."""


class _PatientClient(JobSubmissionClient):
    """Ray's client, which waits for ever otherwise."""

    def _do_request(self, *arguments: Any, **settings: Any) -> Any:
        return super()._do_request(*arguments, timeout=ANSWER_S, **settings)


class RayDrivers(Drivers):
    """The job API at an HTTP address."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._connected: _PatientClient | None = None

    def states(self) -> dict[str, Driver]:
        """From one listing of all jobs."""
        with self._explained():
            return {
                job.submission_id: Driver("over" if job.status.is_terminal() else "running", _first_line(job.message))
                for job in self._client().list_jobs()
                if job.submission_id
            }

    def hand_over(self, submission: str, entrypoint: str, metadata: Mapping[str, str]) -> None:
        """Ray itself refuses a submission id that it knows."""
        with self._explained():
            try:
                self._client().submit_job(entrypoint=entrypoint, submission_id=submission, metadata=dict(metadata))
            except RuntimeError:
                if submission not in self.states():
                    raise

    def stop(self, submission: str) -> None:
        """Ray sends SIGTERM, and SIGKILL three seconds later."""
        with self._explained():
            self._client().stop_job(submission)

    def log(self, submission: str) -> str | None:
        """The file that Ray keeps on the head."""
        with self._explained():
            return self._client().get_job_logs(submission) if submission in self.states() else None

    def _client(self) -> "_PatientClient":
        """A client; Ray's own asks for the version first, and so notices a server that does not answer."""
        if self._connected is None:
            self._connected = _PatientClient(self._address)
        return self._connected

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
