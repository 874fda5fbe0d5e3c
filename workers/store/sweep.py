"""Clearing of `_staging/`: winners are published, losers removed, attempts that may still win left alone."""

from collections.abc import Collection

from schemas.dataset.layout import (
    COMMITS,
    FENCED,
    LOCK_CLAIMS,
    PROBE_PREFIX,
    STAGING,
    TEMPORARY,
    commit_path,
    parse_range_name,
    staging_path,
)
from schemas.errors import CorruptError
from workers.store.attempt import retry_of_attempt
from workers.store.commit import publish, read_record
from workers.store.store import Store


def sweep(store: Store, fenced: Collection[tuple[int, str]] | None = ()) -> list[str]:
    """Publishes committed ranges and removes staging that lost; returns the attempts removed.

    Attempts at ranges that are not committed stay, except those in `fenced`, pairs of (start, attempt) whose workers are
    believed to be dead. None means all of them, and the files of a merge that was killed: for a coordinator that holds
    the lock and has no worker yet.
    """
    removed = []
    for folder in store.children(STAGING):
        start = parse_range_name(folder)
        if start is None:
            if fenced is None and f"{STAGING}/{folder}" not in (TEMPORARY, LOCK_CLAIMS):
                store.remove_tree(f"{STAGING}/{folder}")
            continue
        for name in store.children(f"{STAGING}/{folder}"):
            attempt = name.removesuffix(FENCED)
            given_up = name.endswith(FENCED) or fenced is None or (start, attempt) in fenced
            if sweep_attempt(store, start, attempt, given_up):
                removed.append(attempt)
        store.remove_empty(f"{STAGING}/{folder}")
    probes = [f"{COMMITS}/{name}" for name, _ in store.scan(COMMITS) if name.startswith(PROBE_PREFIX)]
    for key in [*probes, *(entry.key for entry in store.files(TEMPORARY))]:
        store.remove(key)  # a living process writes its temporary file again
    return removed


def sweep_attempt(store: Store, start: int, attempt: str, given_up: bool) -> bool:
    """Publishes or removes one attempt's folder; True where it was removed.

    An attempt at a range that is not committed is removed only where it is `given_up`, and only after it was fenced:
    should it be alive, it cannot commit any more. A store where it still may (`fence_is_final`) keeps its files until
    another attempt has committed the range.
    """
    staging = staging_path(start, attempt)
    retry = retry_of_attempt(attempt)
    if retry is None:
        raise CorruptError(f"{staging} is not an attempt of this program: move it away")
    if store.size(commit_path(start, retry)) is None:
        if not given_up:
            return False
        store.fence(staging)
    record = read_record(store, start, retry)
    if record is not None and record.attempt == attempt:
        publish(store, record)
        return False
    if record is None and not store.fence_is_final:
        return False
    for folder in (staging, staging + FENCED):
        store.remove_tree(folder)
    return True
