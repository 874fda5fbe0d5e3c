"""What crosses Ray: an order to make ranges, and the small report that comes back. Never an image."""

from typing import Literal

from schemas.base import Frozen
from schemas.dataset.commit import CommitTerms, Span
from schemas.dataset.fingerprint import Fingerprint
from schemas.job.job import Job

Reason = Literal["killed", "time", "memory"]
"""What a worker died of."""


class Blame(Frozen):
    """A scene that killed its worker as often as is allowed: it is not tried again, but recorded."""

    scene_id: int
    reason: Reason
    detail: str
    attempts: int


class ShardOrder(Frozen):
    """What a worker needs to make one shard: everything, and nothing that is large."""

    out: str
    job: Job
    terms: CommitTerms
    """`terms.fingerprint` is filled in by the worker with its own."""
    spans: tuple[Span, ...]
    blamed: tuple[Blame, ...] = ()
    label: str = ""
    """Goes into the names of attempts, so that the coordinator knows its own."""


class SpanReport(Frozen):
    """What came of one range."""

    start: int
    stop: int
    retry: int
    won: bool
    conflict: str | None
    made: int
    failed: dict[str, int]
    """Failures by `kind: reason`."""


class ShardReport(Frozen):
    """What came of one shard: ranges in order, and how long each stage took."""

    spans: tuple[SpanReport, ...]
    seconds: dict[str, float]
    wall_s: float
    cpu_s: float
    """Of the processor, in this process."""
    fingerprint: Fingerprint
    host: str
    pid: int
