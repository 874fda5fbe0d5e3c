"""`verso status`: progress of a dataset, from its commits alone; nothing is written."""

from collections import Counter
from dataclasses import dataclass

import pyarrow.compute as pc

from schemas.dataset.commit import Ledger
from schemas.dataset.layout import COMMITS, STAGING, commit_path
from schemas.errors import OutputError
from services.job.record import read_success
from services.run.lock import Holder, read_holder
from services.run.range_planner import find_lost
from workers.store.attempt import blamed_scene, retry_of_attempt, staged_attempts
from workers.store.ledger import list_commits
from workers.store.store import Store

RATE_COMMITS = 64
"""Number of latest commits that the rate is computed from."""
RATE_LOOKS = 256
"""Number of records whose times are asked for, twice: the latest are among them unless many ranges finish out of order."""


@dataclass(frozen=True)
class Running:
    """An attempt at a range without a commit: running, or left behind by a worker that died."""

    start: int
    attempt: str
    scene_id: int | None
    """The scene in progress; None between scenes, and while the range is committed."""


@dataclass(frozen=True)
class Status:
    """Progress of a dataset."""

    asked: int
    made: int
    failed: dict[str, int]
    """Failures not yet made good by a retry, by `kind: reason`."""
    missing: int
    scenes_per_s: float | None
    """Of the latest commits; None before there are two."""
    digest: str | None
    """Of the finished dataset; None while it is not."""
    running: tuple[Running, ...]
    holder: Holder | None
    """The coordinator that holds the lock."""
    lost: tuple[str, ...] = ()
    """Commits that were there and are gone, a line each."""


def read_status(store: Store, first_scene: int, stop_scene: int) -> Status:
    """Progress of the scenes [first_scene, stop_scene).

    Raises OutputError where there is no dataset, CorruptError for a damaged record.
    """
    ledger = list_commits(store)
    if not ledger.rows.num_rows and not ledger.lost and not store.children(STAGING):
        raise OutputError(f"{store.name} holds no dataset: there is nothing in {COMMITS}")
    failures = ledger.failures
    reasons = pc.binary_join_element_wise(failures.column("kind"), failures.column("reason"), ": ")
    failed = Counter(reasons.to_pylist())
    asked = stop_scene - first_scene
    running = tuple(
        Running(start, attempt, blamed_scene(store, start, attempt))
        for start, attempt in staged_attempts(store)
        if store.size(commit_path(start, retry_of_attempt(attempt) or 0)) is None
    )
    return Status(
        asked=asked,
        made=ledger.committed - failed.total(),
        failed=dict(sorted(failed.items())),
        missing=asked - ledger.committed,
        scenes_per_s=_rate(store, ledger),
        digest=(read_success(store) or {}).get("digest"),
        running=running,
        holder=read_holder(store),
        lost=tuple(find_lost(ledger)),
    )


def _rate(store: Store, ledger: Ledger) -> float | None:
    """Scenes a second over the latest commits, by the times of their records.

    The latest are looked for among those that the kept summary does not have yet, and those of the last ranges.
    """
    scenes = {}
    for at in {
        *ledger.unkept[-RATE_LOOKS:].tolist(),
        *range(max(0, len(ledger.start) - RATE_LOOKS), len(ledger.start)),
    }:
        key = commit_path(int(ledger.start[at]), int(ledger.retry[at]))
        if (written := store.stat(key)) is not None:
            scenes[written.modified_s, key] = ledger.count(at)
    latest = sorted(scenes)[-RATE_COMMITS:]
    if len(latest) < 2 or latest[-1][0] <= latest[0][0]:
        return None
    return sum(scenes[one] for one in latest[1:]) / (latest[-1][0] - latest[0][0])
