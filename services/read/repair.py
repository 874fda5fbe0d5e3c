"""`verso replay --repair`: puts back what was lost, and nothing but bytes whose SHA-256 the commits name."""

import hashlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from schemas.dataset.commit import CommitRecord, FileEntry
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE, RANGES, commit_path, range_name
from schemas.dataset.shard import Fingerprint
from schemas.errors import CorruptError, VersoError
from services.job.record import encode_job, record_job
from services.merge.dataset_card import write_card
from services.merge.merge import merge
from services.read.replay import Maker
from services.read.verdict import COPY, Verdict
from services.read.verify import StoredJob, Terms, check_fingerprint, encode_fingerprint, read_stored_job, verify
from services.read.verify_files import read_stored_success
from services.read.verify_range import commit_groups, is_table, read_records
from services.run.lock import hold_lock
from workers.capture.results import open_sources
from workers.render.raster.gbuffer import shared_renderer
from workers.shard.fingerprint import take_fingerprint
from workers.store.attempt import reopen
from workers.store.commit import committed_files, read_committed
from workers.store.store import Store


@dataclass
class Repair:
    """What was done, a line each, and what `verify` says afterwards."""

    done: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    """What could not be put back, and why."""
    verdict: Verdict = field(default_factory=Verdict)


def repair(store: Store, scenes: Collection[int], progress: Callable[[Verdict], None]) -> Repair:
    """Puts back what can be, for all scenes or for the ranges of some. Raises RunError where another process works there.

    Merged files and DATASET.md are written again where all commits are whole. A commit whose record, or whose measured
    times, are lost is dropped where this stack can make its scenes again: the next run does.
    """
    found = Repair()
    with hold_lock(store):
        _Repairing(store, found).run(scenes)
        found.verdict = verify(store, progress)
        wrong = found.verdict.parts.keys()
        # Files that belong nowhere are not in the way of a merge.
        if {"merge", "card"} & wrong and not {"commit", "file", "job"} & wrong:
            _merge_again(store, found)
            found.verdict = verify(store, progress)
    return found


def _merge_again(store: Store, found: Repair) -> None:
    record = read_stored_job(store, Verdict()).record
    assert record is not None
    job = record.job
    try:
        if "merge" in found.verdict.parts:
            reopen(store)
        merged = merge(store, job.first_scene, job.stop_scene)
        if "merge" in found.verdict.parts:
            found.done.append(f"_SUCCESS and the merged files: written again from the commits, digest {merged.digest}")
        if "card" in found.verdict.parts:
            catalogue = open_sources(job, Path(record.folder))
            write_card(store, record, catalogue, merged)
            found.done.append("DATASET.md: written again")
    except VersoError as error:
        found.left.append(str(error))


class _Repairing:
    """One repair in progress."""

    def __init__(self, store: Store, found: Repair) -> None:
        self._store = store
        self._found = found
        self._terms = Terms()

    def run(self, scenes: Collection[int]) -> None:
        """Everything but merging."""
        store = self._store
        job = read_stored_job(store, Verdict())
        torn: list[int] = []
        readable = []
        for start, retries in commit_groups(store):
            records = read_records(store, start, retries, Verdict())
            if not records:
                torn.append(start)
                continue
            for record in records:
                self._terms.take(record)
            if not scenes or any(start <= scene < records[0].span.stop for scene in scenes):
                readable.append((start, retries))
        if job.record is None or (self._terms.jobs and job.digest not in self._terms.jobs):
            self._found.left.append(f"{JOB_FILE}: is not the job of the commits: no scene can be made again from it")
            return
        self._mend_job(job)
        self._mend_fingerprint()
        maker = Maker(store, job.record)
        for start, retries in readable:
            self._mend_range(maker, start, retries)
        for start in torn:
            if not scenes or start in scenes:
                self._drop(start, "a record of it is damaged or missing")

    def _mend_job(self, job: StoredJob) -> None:
        """Writes job.yaml again where its keys are still those of the commits, and `_SUCCESS` tells how many scenes."""
        assert job.record is not None
        asked = read_stored_success(self._store, Verdict()).asked
        if (job.whole and job.record.digest == job.digest) or asked is None:
            return
        kept = job.record.job
        run = kept.run.model_copy(update={"range_size": next(iter(self._terms.range_sizes))})
        whole = kept.model_copy(update={"scenes": asked[1] - asked[0], "run": run})
        if whole.first_scene == asked[0] and whole.scenes > 0:
            record = record_job(whole, job.record.catalogue, Path(job.record.folder), job.record.inputs)
            self._put(JOB_FILE, encode_job(record))

    def _mend_fingerprint(self) -> None:
        """Writes the fingerprint of this stack, where that is the commits'."""
        verdict = Verdict()
        check_fingerprint(self._store, self._terms, verdict)
        if verdict.faults and self._mine.digest in {stack for stack, _ in self._terms.stacks}:
            self._put(FINGERPRINT_FILE, encode_fingerprint(self._mine))

    def _mend_range(self, maker: Maker, start: int, retries: Sequence[int]) -> None:
        """Puts back the lost files of a range and its retries: tables first, because they name the others."""
        for record in read_records(self._store, start, retries, Verdict()):
            lost_times = self._restore(maker, record, [entry for entry in record.files if is_table(entry)])
            try:
                entries = committed_files(self._store, record)
            except CorruptError:
                entries = record.files
            self._restore(maker, record, [one for one in entries if not is_table(one)])
            if lost_times:
                return self._drop(start, "its measured times are lost, and nothing else tells them")

    def _is_whole(self, record: CommitRecord, entry: FileEntry) -> bool:
        try:
            data = read_committed(self._store, record, entry.path)
        except (CorruptError, OSError):
            return False
        return hashlib.sha256(data).hexdigest() == entry.sha256

    def _restore(self, maker: Maker, record: CommitRecord, entries: Sequence[FileEntry]) -> bool:
        """Puts back those that are missing or damaged. Whether measured times are lost."""
        lost = [entry for entry in entries if not self._is_whole(record, entry)]
        if not lost:
            return False
        missing = {entry.path for entry in lost}
        try:
            for path, data in maker.make_files(record, lost):
                self._put(path, data)
                missing.discard(path)
            why = "does not come out as it was: another stack, other assets or another version made it"
        except VersoError as error:
            why = f"cannot be made again: {error}"
        times = {path for path in missing if path.endswith("/timings.parquet")}
        self._found.left += [f"{path}: {why}; {COPY}" for path in sorted(missing - times)]
        return bool(times)

    def _put(self, path: str, data: bytes) -> None:
        """Writes a file whole and durably in place of what is there."""
        try:
            self._store.remove_empty(path)
            self._store.put(path, data)
            self._store.sync([path])
        except OSError as error:
            self._found.left.append(f"{path}: cannot be written ({error.strerror or error}): move what is there away")
        else:
            self._found.done.append(f"{path}: put back")

    @cached_property
    def _mine(self) -> Fingerprint:
        """This stack's."""
        job = read_stored_job(self._store, Verdict()).record
        return take_fingerprint(shared_renderer(), job.job.drawn.tier if job else "raster")

    def _drop(self, start: int, why: str) -> None:
        """Removes the records of a range whose scenes this stack makes the same again; its images stay until then."""
        key = commit_path(start)
        if self._mine.digest not in {stack for stack, _ in self._terms.stacks}:
            self._found.left.append(f"{key}: {why}, and another stack made it: {COPY}")
            return
        reopen(self._store)
        retries = next((retries for first, retries in commit_groups(self._store) if first == start), [])
        for retry in sorted(retries, reverse=True):
            self._store.remove(commit_path(start, retry))
            self._store.remove_tree(f"{RANGES}/{range_name(start, retry)}")
        self._store.sync([key])
        self._found.left.append(f"{key}: dropped, because {why}: run the job again to make its scenes")
