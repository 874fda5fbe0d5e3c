"""`verso verify`: proves that a folder is exactly its dataset: every scene asked, every file and label, no more.

What ranges say is merged again in a temporary folder, and `_SUCCESS` and its files must be the result. Ranges are read one
by one: memory does not grow with the dataset.
"""

import contextlib
import errno
import sqlite3
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from schemas.dataset.commit import CommitRecord
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
from schemas.dataset.shard import Fingerprint
from schemas.errors import CommitConflict, CorruptError, MachineError
from schemas.job.job import job_digest
from services.job.record import JobRecord, decode_job, is_job_sealed
from services.merge.merge import Merging
from services.merge.reading import PathTable, RangeRows
from services.read.verdict import COPY, Verdict, describe_os_error, read_or_tell
from services.read.verify_files import (
    Known,
    Success,
    check_card,
    check_merged,
    check_success,
    read_stored_success,
    tell_strays,
)
from services.read.verify_range import (
    Reading,
    ReadRange,
    Spans,
    commit_groups,
    find_label_check,
    read_records,
)
from workers.store.commit import commits_digest
from workers.store.file_system import temporary_folder
from workers.store.ledger import read_kept_rows
from workers.store.store import Store


@dataclass(frozen=True)
class StoredJob:
    """A job.yaml as it was found: its record, None where it cannot be read, and whether its bytes are as they were written."""

    record: JobRecord | None = None
    whole: bool = False

    @property
    def digest(self) -> str | None:
        """The job digest of the keys as they are now."""
        return job_digest(self.record.job, self.record.catalogue) if self.record else None


def read_stored_job(store: Store, verdict: Verdict) -> StoredJob:
    """job.yaml, and what is wrong with it by itself."""
    if (data := read_or_tell(store, JOB_FILE, verdict, COPY, "job")) is None:
        return StoredJob()
    try:
        job = StoredJob(decode_job(data, JOB_FILE), is_job_sealed(data))
    except CorruptError as error:
        fault = str(error).removeprefix(JOB_FILE).lstrip(": ").removesuffix(COPY).rstrip(";: ")
        verdict.tell(f"{JOB_FILE}: {fault}", COPY, "job")
        return StoredJob()
    if not job.whole:
        verdict.tell(f"{JOB_FILE}: was altered after a run wrote it: its seal does not match", COPY, "job")
    elif job.record is not None and job.record.digest != job.digest:
        verdict.tell(f"{JOB_FILE}: its digest is not that of its keys", COPY, "job")
    return job


@dataclass
class Terms:
    """The jobs and stacks that commits were made with, each with the first commit that names it."""

    jobs: dict[str, str] = field(default_factory=dict)
    range_sizes: dict[int, str] = field(default_factory=dict)
    stacks: dict[tuple[str, str], str] = field(default_factory=dict)
    """By (fingerprint, mode)."""

    def take(self, record: CommitRecord) -> None:
        """Remembers what a commit says."""
        key, terms = commit_path(record.span.start, record.span.retry), record.terms
        self.jobs.setdefault(terms.job_digest, key)
        self.range_sizes.setdefault(terms.range_size, key)
        self.stacks.setdefault((terms.fingerprint, terms.fingerprint_mode), key)


def check_terms(job: StoredJob, terms: Terms, verdict: Verdict) -> None:
    """Compares job.yaml with the job digest that every commit holds."""
    if job.record is None or not terms.jobs:
        return
    if job.digest not in terms.jobs:
        digest, key = next(iter(terms.jobs.items()))
        what = f"its keys or asset files (digest {str(job.digest)[:12]}) are not those of {key} ({digest[:12]})"
        verdict.tell(f"{JOB_FILE}: {what}", f"{COPY}, or change them back", "job")
    else:
        for digest, key in terms.jobs.items():
            if digest != job.digest:
                verdict.tell(f"{key}: is a commit of another job ({digest[:12]}) than {JOB_FILE}", COPY)
    size = job.record.job.range_size
    if size not in terms.range_sizes:
        what = f"run.range_size is {size}, that of the commits {next(iter(terms.range_sizes))}"
        verdict.tell(f"{JOB_FILE}: {what}", f"{COPY}, or change it back", "job")


def check_fingerprint(store: Store, terms: Terms, verdict: Verdict) -> None:
    """Compares the stored fingerprint with those of the commits, to the byte."""
    if (data := read_or_tell(store, FINGERPRINT_FILE, verdict, COPY, "job")) is None:
        return
    try:
        stored = Fingerprint.model_validate_json(data)
    except ValueError:
        stored = None
    if stored is None or data != encode_fingerprint(stored):
        verdict.tell(f"{FINGERPRINT_FILE}: was altered after a worker wrote it", COPY, "job")
    elif stored.digest not in {stack for stack, _ in terms.stacks}:
        if terms.stacks and not _is_in_card(store, stored):
            what = f"{FINGERPRINT_FILE}: is the fingerprint {stored.digest[:12]}, which no commit has"
            verdict.tell(what, COPY, "job")
    else:
        for (stack, mode), key in terms.stacks.items():
            if mode == "strict" and stack != stored.digest:
                what = f"{key}: has the fingerprint {stack[:12]}, the dataset's is {stored.digest[:12]}"
                verdict.tell(what, "two stacks made one dataset although run.fingerprint was strict; make it anew")


def encode_fingerprint(fingerprint: Fingerprint) -> bytes:
    """The bytes of manifest/_fingerprint.json, as the first worker writes it."""
    return fingerprint.model_dump_json(indent=1).encode()


def _is_in_card(store: Store, stored: Fingerprint) -> bool:
    """Whether DATASET.md names a stack: under `run.fingerprint: record` the first worker may have committed nothing."""
    try:
        return stored.digest.encode() in store.read(README_FILE)
    except OSError:
        return False


TOP_FILES = (JOB_FILE, README_FILE, SUCCESS_FILE, FINGERPRINT_FILE, LEDGER_FILE, CAM_POSES, CAMERAS, OBJECTS)
"""Files with one place each; whether they are whole is checked by name."""


def verify(store: Store, progress: Callable[[Verdict], None]) -> Verdict:
    """Reads everything back. Raises OutputError where a newer version wrote it, MachineError where TMPDIR is full."""
    verdict = Verdict(store.name)
    with _temporary_folder() as folder, contextlib.closing(PathTable(folder / "paths.sqlite")) as index:
        job, success = read_stored_job(store, verdict), read_stored_success(store, verdict)
        reading = Reading(store, job.record.job if job.record else None, job.digest, index, verdict)
        # The scenes that must be there: by job.yaml, or by `_SUCCESS` where job.yaml is damaged.
        asked = (job.record.job.first_scene, job.record.job.stop_scene) if job.record else None
        range_size = job.record.job.range_size if job.record else 16
        altered = success.asked if success.asked and not job.whole else asked
        spans, terms = Spans(altered, range_size, success.data is not None, verdict), Terms()
        (folder / "merged").mkdir()
        with contextlib.closing(Merging(folder / "merged")) as merging:
            _read_ranges(reading, spans, terms, merging, progress)
            remade = _merge_again(merging, spans, verdict)
        check_terms(job, terms, verdict)
        check_fingerprint(store, terms, verdict)
        _check_finished(store, success, spans, remade, index, verdict)
        _check_ledger(store, verdict)
        index.add_paths(TOP_FILES)
        lost = sorted([*spans.gaps, *spans.unreadable])
        pairs = job.record.job.pairs_per_scene if job.record else 1
        tell_strays(store, Known(index, success.data is None, tuple(lost), 2 * pairs), verdict)
    return verdict


def _read_ranges(
    reading: Reading, spans: Spans, terms: Terms, merging: Merging, progress: Callable[[Verdict], None]
) -> None:
    """Reads every range in order, and merges it again, as long as all can be."""
    check_scene = None
    try:
        check_scene = find_label_check()
    except MachineError as error:
        reading.verdict.not_derived = str(error)
    groups = commit_groups(reading.store)
    following = [*(start for start, _ in groups[1:]), sys.maxsize]
    for (start, retries), next_start in zip(groups, following, strict=True):
        reading.index.add_paths(commit_path(start, retry) for retry in retries)
        records = read_records(reading.store, start, retries, reading.verdict)
        if not records:  # nothing says where it ends
            spans.take(start, min(start + spans.range_size, next_start), False)
            continue
        spans.take(start, records[0].span.stop, True)
        for record in records:
            terms.take(record)
        read = ReadRange(reading, records)
        read.check(check_scene)
        spans.staged += read.staged
        if read.rows is not None and spans.fits:
            try:
                merging.add(RangeRows(records, read.files, read.rows))
            except CorruptError as error:
                reading.verdict.tell(str(error), COPY)
                read.rows = None
        if read.rows is None:
            spans.unreadable.append((start, records[0].span.stop))
        progress(reading.verdict)
    spans.finish()


def _merge_again(merging: Merging, spans: Spans, verdict: Verdict) -> tuple[dict[str, Any], dict[str, Path]] | None:
    """`_SUCCESS` and the merged files as the commits give them; None where not every range can be read."""
    if not spans.fits or not spans.done:
        return None
    try:
        return merging.finish()
    except (CorruptError, CommitConflict) as error:
        verdict.tell(str(error), COPY)
        return None


def _check_finished(
    store: Store,
    success: Success,
    spans: Spans,
    remade: tuple[dict[str, Any], dict[str, Path]] | None,
    index: PathTable,
    verdict: Verdict,
) -> None:
    """Compares what the merge wrote with what the commits give, or says that the dataset is not finished."""
    if remade is not None:
        index.add_paths(remade[1])
    index.add_paths(success.files)
    if success.data is None:
        _tell_unfinished(spans, remade and remade[0], verdict)
        return
    if spans.staged:
        verdict.tell(f"{spans.staged} committed files are in _staging, and not in their places", verdict.run_again)
    digest = success.tree.get("digest")
    if remade is None:
        check_merged(store, success, {}, verdict)
    else:
        expected, files = remade
        first, stop = spans.asked or (0, 0)
        entries = check_merged(store, success, files, verdict)
        commits = success.tree.get("commits")
        with contextlib.suppress(CorruptError):  # a foreign file among the commits is told as a stray
            commits = commits_digest(store)
        asked = {"first_scene": first, "stop_scene": stop, "commits": commits}
        check_success(success, {**expected, "files": entries, **asked}, verdict)
        digest = expected["digest"]
    if isinstance(digest, str):
        check_card(store, digest, verdict)


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


def _tell_unfinished(spans: Spans, remade: dict[str, Any] | None, verdict: Verdict) -> None:
    """Says why there is no `_SUCCESS`, which is a fault: a dataset is whole or it is not."""
    missing = f"{SUCCESS_FILE}: is missing, not finished:"
    if remade is None:
        asked = spans.asked
        words = f"{spans.done} of {asked[1] - asked[0]} scenes" if asked else f"{spans.done} scenes"
        verdict.tell(f"{missing} {words} are committed", verdict.run_again)
    elif again := remade["scenes"]["environmental"]:
        words = f"{again} scenes failed for environmental reasons"
        verdict.tell(f"{missing} {words}", f"{verdict.run_again} --retry-failed")
    else:
        words = "every scene is committed, and they were not merged, or the file was removed"
        verdict.tell(f"{missing} {words}", verdict.run_again, "merge")


@contextlib.contextmanager
def _temporary_folder() -> Iterator[Path]:
    """A folder for what the ranges share. Raises MachineError where it is full."""
    with temporary_folder("verify") as folder:
        try:
            yield folder
        except (OSError, sqlite3.Error) as error:
            if isinstance(error, OSError) and error.errno != errno.ENOSPC:
                raise
            keeps = "verify keeps the merged tables and the list of files there"
            raise MachineError(f"{folder}: {error}; {keeps}: set TMPDIR to a folder with more room") from error
