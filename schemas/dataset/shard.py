"""Messages that cross Ray: the order to make a shard, and the report of it. Never an image."""

from typing import Literal

from schemas.base import Frozen
from schemas.dataset.commit import CommitSummary, CommitTerms, Span
from schemas.dataset.fingerprint import Fingerprint
from schemas.job.job import Job

Reason = Literal["killed", "time", "memory"]
"""The cause of a worker's death."""


class Blame(Frozen):
    """A scene that killed its worker `max_attempts` times: it is recorded and not tried again."""

    scene_id: int
    reason: Reason
    detail: str
    attempts: int


class JobChange(Frozen):
    """A job.yaml to be replaced just before the first commit of an extension: until then, what is there holds."""

    before: str
    after: str


class ShardOrder(Frozen):
    """Everything that a worker needs to make one shard."""

    out: str
    job: Job
    terms: CommitTerms
    """`terms.fingerprint` is filled in by the worker with its own."""
    spans: tuple[Span, ...]
    blamed: tuple[Blame, ...] = ()
    job_change: JobChange | None = None
    """None where job.yaml is what it will be."""
    label: str = ""
    """Part of the attempts' names: the coordinator recognises its own."""

    @classmethod
    def of(cls, out: str, job: Job, job_digest: str) -> "ShardOrder":
        """The pattern of every order of a job: without ranges and without a fingerprint."""
        terms = CommitTerms(
            job_digest=job_digest,
            fingerprint="",
            fingerprint_mode=job.run.fingerprint,
            layout=job.output.layout,
            first_scene=job.first_scene,
            range_size=job.range_size,
            pairs_per_scene=job.pairs_per_scene,
        )
        return cls(out=out, job=job, terms=terms, spans=())


class SpanReport(Frozen):
    """The result of one range."""

    start: int
    stop: int
    retry: int
    won: bool
    conflict: str | None
    made: int
    failed: dict[str, int]
    """Failures by `kind: reason`."""
    bugs: tuple[str, ...] = ()
    """Scenes that ended in an error nobody expected: the scene, what is in it, and the error, each in one line."""
    commit: CommitSummary | None = None
    """What the valid record says, for the ledger."""


class ShardReport(Frozen):
    """The result of one shard: its ranges in order, and the seconds of each stage."""

    spans: tuple[SpanReport, ...]
    seconds: dict[str, float]
    wall_s: float
    cpu_s: float
    """Processor time of this process."""
    fingerprint: Fingerprint
    host: str
    pid: int
