"""Commits that a dataset had once and has no more: by the kept summary of the ledger, and by what `_SUCCESS` says."""

from collections import Counter

import numpy as np

from schemas.dataset.commit import Ledger
from schemas.dataset.layout import commit_path
from services.merge.merge import read_success
from workers.store.commit import commits_digest
from workers.store.ledger import list_commits
from workers.store.store import Store

REMEDY = "restore it from a copy, or run the job again to make its scenes anew"
MOST_TOLD = 20
DIGEST_UP_TO = 100_000
"""Commits whose sizes are compared with `_SUCCESS` too, which takes a second; `verso verify` compares any number."""


def find_lost(store: Store, ledger: Ledger | None = None) -> list[str]:
    """What is lost, a line each with the remedy; empty where every commit that there was is there.

    `ledger` is what `list_commits` returned, if it was called. Raises as `list_commits`.
    """
    ledger = ledger or list_commits(store)
    lines = [
        f"{commit_path(start, retry)} is lost: it was committed, and is gone; {REMEDY}" for start, retry in ledger.lost
    ]
    if len(lines) > MOST_TOLD:
        lines[MOST_TOLD:] = [f"{len(lines) - MOST_TOLD} more commits are lost; {REMEDY}"]
    return lines or _compare_with_success(store, ledger)


def _compare_with_success(store: Store, ledger: Ledger) -> list[str]:
    """What the finished dataset says it was made of, against the commits that are there."""
    success = read_success(store) or {}
    first, stop = success.get("first_scene"), success.get("stop_scene")
    if not isinstance(first, int) or not isinstance(stop, int):
        return []
    if gap := _first_gap(ledger, first, stop):
        return [f"the commits of scenes {gap[0]} to {gap[1] - 1} of the finished dataset are lost; {REMEDY}"]
    failed = Counter(ledger.failures.column("kind").to_pylist())
    counts = {"intrinsic": 0, "environmental": 0, **failed, "made": ledger.committed - failed.total()}
    few = len(ledger.start) <= DIGEST_UP_TO
    if success.get("scenes") != counts or (few and success.get("commits") != commits_digest(store)):
        return ["the commits are not those that the finished dataset was merged from: run the job again to merge them"]
    return []


def _first_gap(ledger: Ledger, first: int, stop: int) -> tuple[int, int] | None:
    """The first scenes of [first, stop) that no commit holds."""
    starts, stops = ledger.ranges.T
    ends = np.append(first, stops)
    gaps = np.flatnonzero(np.append(starts, stop) > ends)
    return (int(ends[gaps[0]]), min(int(np.append(starts, stop)[gaps[0]]), stop)) if len(gaps) else None
