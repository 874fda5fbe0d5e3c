"""What a queue stores of a job: its request, and the events that have happened to it. Nothing of it is ever rewritten."""

from typing import Annotated, Any, Final, Literal

from pydantic import Field, model_validator

from schemas.base import Folder, Frozen, NonNegativeInt, PositiveInt, Text

MARK_FILE: Final = "queue.json"
"""What makes a folder or a bucket's prefix a queue."""
SHARE_FILE: Final = "share.json"
"""How many jobs share the cluster now: advice to the drivers, written anew by the supervisor. No state depends on it."""
JOBS: Final = "jobs"
REQUEST: Final = "request.json"

ID_PATTERN: Final = r"^j[0-9a-f]{8}$"

MOST_JOB_CHARACTERS: Final = 250_000
"""As many as a job file may have bytes."""

JobId = Annotated[str, Field(pattern=ID_PATTERN)]
Priority = Annotated[int, Field(ge=-1000, le=1000)]


class JobRequest(Frozen):
    """A job as it was submitted: `jobs/<id>/request.json`."""

    queue: Literal[1] = 1
    """schema_version."""
    id: JobId
    name: Text
    """The job's name, for people."""
    text: Annotated[str, Field(max_length=MOST_JOB_CHARACTERS)]
    """The job file, as it was read."""
    changes: tuple[str, ...] = ()
    """`path.to.key=value`, in the order in which they are applied."""
    folder: Folder
    """Where the job file lay."""
    out: Folder
    """The output folder: an absolute path, or the URL of an object store."""
    scenes: PositiveInt
    retry_failed: bool = False
    priority: Priority = 0
    """Higher ones first."""
    submitted: float
    """Seconds since 1970 by the submitter's clock; orders jobs of one priority, and nothing else depends on it."""

    @model_validator(mode="after")
    def _findable(self) -> Any:
        if not self.folder.startswith("/") or not (self.out.startswith("/") or "://" in self.out):
            raise ValueError("`folder` is an absolute path, `out` one or a URL")
        return self


EventKind = Literal["started", "began", "busy", "ended", "died", "cancel", "stopped"]
"""What can happen to a job.

- started: the supervisor decided on an attempt, and is about to hand its driver to Ray
- began: the driver of that attempt is at work; it puts this before it does anything
- busy: that driver found another run in the output folder, and left
- ended: that driver has come to an end, good or bad, and told it
- died: the supervisor found that the driver of that attempt is gone without a word
- cancel: somebody asked for the job to end
- stopped: no driver of a cancelled job is left, or the supervisor ended and its drivers with it: that job waits again
"""


class JobEvent(Frozen):
    """One thing that happened to a job: `jobs/<id>/events/<n>.json`, n from 0 without gaps."""

    kind: EventKind
    attempt: NonNegativeInt = 0
    """The attempt that it is about, from 1; 0 for `cancel`."""
    at: float
    """Seconds since 1970 by the writer's clock; for people."""
    nonce: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
    """Differs for all events, so that a writer knows its own again where an answer was lost."""
    code: Annotated[int, Field(ge=0, le=255)] | None = None
    """The exit code of the command; of `ended` alone."""
    note: Text = ""
    """Why, in one line."""
    scenes: NonNegativeInt | None = None
    """Scenes made or failed, where the driver knows; of `ended` alone."""
    digest: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """Of the finished dataset; of `ended` alone."""

    @model_validator(mode="after")
    def _complete(self) -> Any:
        if (self.kind == "ended") != (self.code is not None):
            raise ValueError("`code` belongs to `ended`, which needs it")
        if (self.kind == "cancel") != (self.attempt == 0):
            raise ValueError("`attempt` counts from 1, and only `cancel` has none")
        return self


def request_path(job: str) -> str:
    """The key of a job's request."""
    return f"{JOBS}/{job}/{REQUEST}"


def events_folder(job: str) -> str:
    """The folder of a job's events."""
    return f"{JOBS}/{job}/events"


def log_path(job: str, attempt: int) -> str:
    """The key of the copy of an attempt's log."""
    return f"{JOBS}/{job}/logs/{attempt:04d}.txt"


def submission_id(job: str, attempt: int) -> str:
    """The name that an attempt's driver has in Ray's job API."""
    return f"verso-{job}-{attempt}"
