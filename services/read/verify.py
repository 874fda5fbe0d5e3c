"""`verso verify`: proves that a folder is exactly its dataset: every scene asked, every file and label, and nothing else.

Ranges are read one by one, and what they share is kept in a temporary folder: memory does not grow with the dataset.
"""

import contextlib
import errno
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from schemas.dataset.layout import (
    CAM_POSES,
    CAMERAS,
    FINGERPRINT_FILE,
    JOB_FILE,
    LEDGER_FILE,
    OBJECTS,
    README_FILE,
    SUCCESS_FILE,
    commit_path,
)
from schemas.errors import CommitConflict, CorruptError, MachineError
from services.read.path_index import PathIndex
from services.read.remerge import Remerge
from services.read.stray_files import Known, tell_strays
from services.read.verdict import COPY, Verdict, describe_os_error
from services.read.verify_finished import (
    Success,
    check_card,
    check_merged,
    check_success,
    check_told,
    read_stored_success,
)
from services.read.verify_job import StoredJob, Terms, check_fingerprint, check_terms, read_stored_job
from services.read.verify_range import RangeCheck, read_records
from services.read.verify_span import Spans, commit_groups
from workers.scene.context import keep_freed_memory
from workers.store.commit import commits_digest
from workers.store.file_system import temporary_folder
from workers.store.ledger import read_kept_rows
from workers.store.store import Store

TOP_FILES = (JOB_FILE, README_FILE, SUCCESS_FILE, FINGERPRINT_FILE, LEDGER_FILE, CAM_POSES, CAMERAS, OBJECTS)
"""Files with one place each; whether they are whole is checked by name."""


@dataclass
class Ranges:
    """What reading the ranges found."""

    spans: Spans
    terms: Terms
    mergeable: bool = True
    """Whether the rows of every range went into the merge."""
    staged: int = 0
    """Files that are committed and not published."""


def verify(store: Store, progress: Callable[[Verdict], None]) -> Verdict:
    """Reads everything back. Raises OutputError where a newer version wrote it, MachineError where TMPDIR is full."""
    keep_freed_memory()
    verdict = Verdict(store.name)
    with _temporary_folder() as folder, contextlib.closing(PathIndex(folder)) as index:
        job, success = read_stored_job(store, verdict), read_stored_success(store, verdict)
        with contextlib.closing(Remerge(_made(folder / "merged"))) as merging:
            check = RangeCheck(store, job.record, job.digest, index, verdict)
            found = _read_ranges(store, _spans(job, success, verdict), check, merging, progress)
            check_terms(job, found.terms, verdict)
            check_fingerprint(store, found.terms, verdict)
            remade = _merge_again(merging, found, verdict)
        _check_finished(store, job, success, found, remade, index, verdict)
        _check_ledger(store, verdict)
        index.add_all(TOP_FILES)
        lost = sorted([*found.spans.gaps, *found.spans.unreadable])
        pairs = job.record.job.pairs_per_scene if job.record else 1
        tell_strays(store, Known(index, success.data is None, tuple(lost), 2 * pairs), verdict)
    return verdict


def _spans(job: StoredJob, success: Success, verdict: Verdict) -> Spans:
    """The scenes that must be there: by job.yaml, or by `_SUCCESS` where job.yaml is damaged."""
    asked = (job.record.job.first_scene, job.record.job.stop_scene) if job.record else None
    if success.asked and not job.whole:
        asked = success.asked
    range_size = job.record.job.range_size if job.record else 16
    return Spans(asked, range_size, success.data is not None, verdict)


def _read_ranges(
    store: Store, spans: Spans, check: RangeCheck, merging: Remerge, progress: Callable[[Verdict], None]
) -> Ranges:
    """Reads every range in order, and merges it again."""
    found = Ranges(spans, Terms())
    for start, retries in commit_groups(store):
        records = read_records(store, start, retries, check.verdict)
        check.index.add_all(commit_path(start, retry) for retry in retries)
        spans.take(start, records)
        if not records:
            continue
        for record in records:
            found.terms.take(record)
        one = check.check(records)
        found.staged += one.staged
        if one.rows is None:
            spans.spoil(start, records[0].span.stop)
        elif found.mergeable and spans.fits:
            try:
                merging.add(one)
            except CorruptError as error:
                found.mergeable = False
                check.verdict.tell(str(error), COPY)
        progress(check.verdict)
    spans.finish()
    return found


def _merge_again(merging: Remerge, found: Ranges, verdict: Verdict) -> tuple[dict[str, Any], dict[str, Path]] | None:
    """`_SUCCESS` and the merged files as the commits give them; None where not every range can be read."""
    if not (found.mergeable and found.spans.whole):
        return None
    try:
        return merging.finish()
    except (CorruptError, CommitConflict) as error:
        verdict.tell(str(error), COPY)
        return None


def _check_finished(
    store: Store,
    job: StoredJob,
    success: Success,
    found: Ranges,
    remade: tuple[dict[str, Any], dict[str, Path]] | None,
    index: PathIndex,
    verdict: Verdict,
) -> None:
    """Compares what the merge wrote with what the commits give, or says that the dataset is not finished."""
    if remade is not None:
        index.add_all(remade[1])
    index.add_all(success.files)
    if success.data is None:
        _tell_unfinished(found, remade and remade[0], verdict)
        return
    if found.staged:
        verdict.tell(f"{found.staged} committed files are in _staging, and not in their places", verdict.run_again)
    digest = success.told.get("digest")
    if remade is None:
        check_told(store, success, verdict)
    else:
        expected, files = remade
        first, stop = found.spans.asked or (0, 0)
        entries = check_merged(store, success, files, verdict)
        commits = success.told.get("commits")
        with contextlib.suppress(CorruptError):  # a foreign file among the commits is told as a stray
            commits = commits_digest(store)
        asked = {"first_scene": first, "stop_scene": stop, "commits": commits}
        check_success(success, {**expected, "files": entries, **asked}, verdict)
        digest = expected["digest"]
    if isinstance(digest, str):
        check_card(store, digest, job.sealed, verdict)


def _check_ledger(store: Store, verdict: Verdict) -> None:
    """The kept summary of the commits: as it was written, and every retry that it names is there, as ranges were checked."""
    try:
        rows = read_kept_rows(store)
    except CorruptError as error:
        what, _, remedy = str(error).partition(": ")
        verdict.tell(what, remedy)
        return
    except OSError as error:
        verdict.tell(f"{LEDGER_FILE}: {describe_os_error(error)}", "remove it, the next run writes it again")
        return
    if rows is None:
        return
    for start, retry in zip(rows.column("start").to_numpy(), rows.column("retry").to_numpy(), strict=True):
        if retry and store.size(commit_path(int(start), int(retry))) is None:
            verdict.tell(f"{commit_path(int(start), int(retry))}: is missing, {LEDGER_FILE} names it", COPY)


def _tell_unfinished(found: Ranges, remade: dict[str, Any] | None, verdict: Verdict) -> None:
    """Says why there is no `_SUCCESS`, which is a fault: a dataset is whole or it is not."""
    missing = f"{SUCCESS_FILE}: is missing, not finished:"
    if remade is None:
        asked = found.spans.asked
        told = f"{found.spans.done} of {asked[1] - asked[0]} scenes" if asked else f"{found.spans.done} scenes"
        verdict.tell(f"{missing} {told} are committed", verdict.run_again)
    elif again := remade["scenes"]["environmental"]:
        told = f"{again} scenes failed for environmental reasons"
        verdict.tell(f"{missing} {told}", f"{verdict.run_again} --retry-failed")
    else:
        told = "every scene is committed, and they were not merged, or the file was removed"
        verdict.tell(f"{missing} {told}", f"{verdict.run_again}, or {verdict.repair}", "merge")


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


@contextlib.contextmanager
def _temporary_folder() -> Iterator[Path]:
    """A folder for what the ranges share. Raises MachineError where it is full."""
    with temporary_folder("verify") as folder:
        try:
            yield folder
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            raise MachineError(
                f"{folder} is full: verify keeps the merged tables there; set TMPDIR to a folder with more room"
            ) from error
