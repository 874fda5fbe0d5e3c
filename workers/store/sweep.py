"""Clearing `_staging/`: what won is published, what lost is dropped, what may still win is left alone."""

from collections.abc import Collection

from schemas.dataset.layout import COMMITS, STAGING, commit_path, staging_path
from schemas.errors import CorruptError
from workers.store.attempt import retry_of_attempt
from workers.store.commit import publish, read_record
from workers.store.store import PROBE_PREFIX, TEMPORARY, Store, fenced_key

_FENCED = ".fenced"


def sweep(store: Store, fenced: Collection[tuple[int, str]] | None = ()) -> list[str]:
    """Rolls committed ranges forward and drops staging that lost; returns the attempts dropped.

    Attempts at ranges that nobody has committed are left, but for those in `fenced`, pairs of (start, attempt) whose
    workers are known to be dead. None means all of them: for a coordinator that holds the lock and has no worker yet.
    An attempt that proves to be alive has lost its folder before this function looked for its commit, so it cannot
    commit any more (on a disk; an object store cannot refuse it, so give only attempts that are dead).
    """
    dropped = []
    for folder in store.children(STAGING):
        if not folder.isdigit():
            continue
        start = int(folder)
        for name in store.children(f"{STAGING}/{folder}"):
            attempt = name.removesuffix(_FENCED)
            given_up = name.endswith(_FENCED) or fenced is None or (start, attempt) in fenced
            if _settle(store, start, attempt, given_up):
                dropped.append(attempt)
        store.remove_empty(f"{STAGING}/{folder}")
    _sweep_temporaries(store)
    return dropped


def _settle(store: Store, start: int, attempt: str, given_up: bool) -> bool:
    """Publishes or drops one attempt's folder; True where it was dropped."""
    retry = retry_of_attempt(attempt)
    if retry is None:
        raise CorruptError(f"{staging_path(start, attempt)} is not an attempt of this program: move it away")
    staging = staging_path(start, attempt)
    committed = store.size(commit_path(start, retry)) is not None
    if not committed:
        if not given_up:
            return False
        store.fence(staging)
    record = read_record(store, start, retry)
    if record is not None and record.attempt == attempt:
        publish(store, record)
        return False
    for folder in (staging, fenced_key(staging)):
        store.remove_tree(folder)
    return True


def _sweep_temporaries(store: Store) -> None:
    """Drops what killed processes left beside the attempts; a living one writes its temporary file again."""
    probes = [entry for entry in store.files(COMMITS) if entry.key.startswith(f"{COMMITS}/{PROBE_PREFIX}")]
    for entry in [*probes, *store.files(TEMPORARY)]:
        store.remove(entry.key)
