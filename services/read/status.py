"""`verso status`: progress of a dataset, from its commits alone; nothing is written."""

from collections import Counter
from dataclasses import dataclass

from schemas.dataset.layout import COMMITS, STAGING, commit_path, parse_range_name
from schemas.errors import OutputError
from services.merge.step import read_success
from services.run.lock import Holder, read_holder
from services.run.range_planner import effective_failures, ranges_with_retries
from workers.store.attempt import attempts_at, blamed_scene, retry_of_attempt
from workers.store.commit import commit_names, read_record
from workers.store.committed_rows import list_commits, range_rows
from workers.store.store import Store

RATE_COMMITS = 64
"""Number of latest commits that the rate is computed from."""


@dataclass(frozen=True)
class Running:
    """An attempt at a range without a commit: running, or left behind by a worker that died."""

    start: int
    attempt: str
    scene_id: int | None
    """The scene in progress; None between scenes."""


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


def read_status(store: Store, first_scene: int, stop_scene: int) -> Status:
    """Progress of the scenes [first_scene, stop_scene).

    Raises OutputError where there is no dataset, CorruptError for a damaged record.
    """
    summaries = list_commits(store)
    if not summaries and not store.children(STAGING):
        raise OutputError(f"{store.name} holds no dataset: there is nothing in {COMMITS}")
    failed: Counter[str] = Counter()
    committed = 0
    for group in ranges_with_retries(summaries):
        committed += group[0].stop - group[0].start
        if effective_failures(group):
            failed.update(_reasons(store, group[0].start, len(group)))
    asked = stop_scene - first_scene
    return Status(
        asked=asked,
        made=committed - failed.total(),
        failed=dict(sorted(failed.items())),
        missing=asked - committed,
        scenes_per_s=_rate(store),
        digest=(read_success(store) or {}).get("digest"),
        running=tuple(_running(store)),
        holder=read_holder(store),
    )


def _reasons(store: Store, start: int, commits: int) -> Counter[str]:
    records = [record for retry in range(commits) if (record := read_record(store, start, retry)) is not None]
    rows = range_rows(store, records, "failures")
    kinds, reasons = rows.column("kind").to_pylist(), rows.column("reason").to_pylist()
    return Counter(f"{kind}: {reason}" for kind, reason in zip(kinds, reasons, strict=True))


def _rate(store: Store) -> float | None:
    """Scenes a second over the latest commits, by the times of their records."""
    times = ((store.modified(key), start, retry) for start, retry, key in commit_names(store))
    latest = sorted((written, start, retry) for written, start, retry in times if written is not None)[-RATE_COMMITS:]
    if len(latest) < 2 or latest[-1][0] <= latest[0][0]:
        return None
    records = [read_record(store, start, retry) for _, start, retry in latest[1:]]
    scenes = sum(len(record.scenes) for record in records if record is not None)
    return scenes / (latest[-1][0] - latest[0][0])


def _running(store: Store) -> list[Running]:
    starts = [start for folder in store.children(STAGING) if (start := parse_range_name(folder)) is not None]
    return [
        Running(start, attempt, blamed_scene(store, start, attempt))
        for start in starts
        for attempt in attempts_at(store, start)
        if store.size(commit_path(start, retry_of_attempt(attempt) or 0)) is None
    ]
