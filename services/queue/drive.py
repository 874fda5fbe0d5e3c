"""One attempt at a job of the queue, as it happens on the cluster's head: begin, make the dataset, tell the end."""

from collections.abc import Callable
from dataclasses import dataclass

from schemas.errors import InUseError, RunError, VersoError, plain_line
from schemas.queue import JobRequest
from services.queue.store import Queue

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
