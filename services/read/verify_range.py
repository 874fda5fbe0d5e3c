"""Committed ranges read back: which there must be, and of each its record, tables, files and labels."""

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, groupby
from operator import itemgetter

import pyarrow as pa

from schemas.dataset.commit import CommitRecord, FileEntry
from schemas.dataset.layout import COMMITS, RANGES, commit_path, is_shape, parse_commit_name, stored_roles
from schemas.dataset.tables import DETERMINISTIC_TABLES, TABLES
from schemas.errors import CorruptError, MachineError, needs_making
from schemas.job.job import Job
from services.job.record import JobRecord
from services.read.dataset_reader import ReadFile, StoredRange, file_reader, read_image
from services.read.verdict import COPY, MOST_FAULTS, PathIndex, Verdict, describe_os_error
from workers.store.commit import committed_files, read_committed, read_record
from workers.store.ledger import range_rows
from workers.store.store import Store
from workers.store.tars import check_labels


def commit_groups(store: Store) -> Iterator[tuple[int, list[int]]]:
    """(start, retries) of every range that has a commit record, in order. Other files are left to the search for strays."""
    files = (entry.key.removeprefix(f"{COMMITS}/") for entry in store.files(COMMITS, sizes=False))
    names = sorted(name for file in files if (name := parse_commit_name(file)) is not None)
    for start, group in groupby(names, key=itemgetter(0)):
        yield start, [retry for _, retry in group]


class Spans:
    """Takes ranges in order; knows the scenes that no range holds, and those whose commit or tables cannot be read."""

    def __init__(self, asked: tuple[int, int] | None, range_size: int, finished: bool, verdict: Verdict) -> None:
        self.asked = asked
        """First scene and stop; None where neither job.yaml nor `_SUCCESS` says it."""
        self.gaps: list[tuple[int, int]] = []
        self.unreadable: list[tuple[int, int]] = []
        """Scenes [start, stop) of a damaged range; stop is a guess where its record cannot be read."""
        self.done = 0
        """Committed scenes."""
        self.foreign = False
        """Whether scenes are committed twice, or outside of those asked."""
        self._range_size = range_size
        self._finished = finished
        self._verdict = verdict
        self._awaited = None if asked is None else asked[0]
        self._torn: int | None = None
        """Start of the damaged range just before, whose stop is not known."""

    @property
    def fits(self) -> bool:
        """Whether the ranges taken so far can be merged; after the last, whether every scene asked is committed once."""
        return not (self.gaps or self.unreadable or self.foreign or self._torn is not None)

    def take(self, start: int, records: tuple[CommitRecord, ...]) -> None:
        """The next range, with its retries; without records where they cannot be read."""
        self._reach(start)
        if not records:
            self._torn = start
            return
        stop = records[0].span.stop
        self.done += stop - start
        if self.asked is not None and not self.asked[0] <= start < stop <= self.asked[1]:
            self.foreign = True
            told = f"{commit_path(start)}: scenes {start} to {stop - 1} are committed, outside of those asked"
            self._verdict.tell(told, f"{self.asked[0]} to {self.asked[1] - 1} are, by job.yaml or _SUCCESS; {COPY}")
        self._awaited = stop

    def finish(self) -> None:
        """After the last range."""
        self._reach(self.asked[1] if self.asked else None)

    def _reach(self, start: int | None) -> None:
        """Goes on to the range at `start`, or to the end."""
        if self._torn is not None:
            guess = self._torn + self._range_size
            self.unreadable.append((self._torn, min(guess, start) if start is not None else guess))
            self._awaited = self.unreadable[-1][1]
            self._torn = None
        if start is None or self._awaited is None:
            return
        if start > self._awaited:
            self._tell_gap(self._awaited, start)
        elif start < self._awaited and (self.asked is None or start != self.asked[1]):
            self.foreign = True
            self._verdict.tell(f"{commit_path(start)}: scene {start} is committed twice", COPY)

    def _tell_gap(self, start: int, stop: int) -> None:
        """Names each missing commit of a finished dataset, the scenes of an unfinished one."""
        self.gaps.append((start, stop))
        first = self.asked[0] if self.asked else start
        size, run = self._range_size, self._verdict.run_again
        line = first + ((start - first) // size + 1) * size
        starts = [start, *range(line, stop, size)] if (stop - start) // size < MOST_FAULTS else [start]
        if not self._finished or len(starts) == 1:
            told = f"{commit_path(start)}: " if self._finished else ""
            self._verdict.tell(f"{told}scenes {start} to {stop - 1} are not committed", f"{run} to make them")
            return
        for begin, end in zip(starts, [*starts[1:], stop], strict=True):
            told = f"{commit_path(begin)}: is missing: scenes {begin} to {end - 1} are not committed"
            self._verdict.tell(told, f"{run} to make them")


@dataclass
class ReadRange:
    """A range as it was found: its records, and its rows by table where all tables are whole."""

    records: tuple[CommitRecord, ...]
    files: tuple[FileEntry, ...] = ()
    """Of all its records."""
    rows: dict[str, pa.Table] | None = None
    staged: int = 0
    """Files that are committed and not in their final places yet."""


def read_records(store: Store, start: int, retries: Sequence[int], verdict: Verdict) -> tuple[CommitRecord, ...]:
    """The records of a range and its retries; empty where one of them is missing or damaged, which is told."""
    for retry in sorted(set(range(max(retries))) - set(retries)):
        verdict.tell(f"{commit_path(start, retry)}: is missing, and later tries of its range are there", COPY)
    records = []
    for retry in retries:
        key = commit_path(start, retry)
        try:
            record = read_record(store, start, retry)
        except CorruptError as error:
            told = _without_remedy(error).removeprefix(key).lstrip(": ")
            verdict.tell(f"{key}: {told}", verdict.make_again(start))
        except OSError as error:
            verdict.tell(f"{key}: {describe_os_error(error)}", COPY)
        else:
            if record is not None:
                records.append(record)
    whole = len(records) == len(retries) == max(retries) + 1
    return tuple(records) if whole else ()


class RangeCheck:
    """Reads ranges back, and keeps in `index` the path of every file that they name."""

    def __init__(
        self, store: Store, job: JobRecord | None, job_digest: str | None, index: PathIndex, verdict: Verdict
    ) -> None:
        self._store = store
        self._job = job.job if job else None
        self._job_digest = job_digest
        """Of the keys of job.yaml as they are: labels of commits of another job cannot be derived."""
        self.index = index
        self.verdict = verdict
        self._check_scene: CheckScene | None = None
        try:
            self._check_scene = _label_check()
        except MachineError as error:
            verdict.not_derived = str(error)

    def check(self, records: tuple[CommitRecord, ...]) -> ReadRange:
        """Reads one range with its retries."""
        found = ReadRange(records)
        damaged: set[str] = set()
        unknown: list[str] = []
        entries = [self._entries(record, unknown) for record in records]
        found.files = tuple(chain.from_iterable(entries))
        for files in entries:
            self._check_files([one for one in files if is_table(one)], {}, damaged, found)
        if unknown and not damaged:
            self.verdict.tell(unknown[0], COPY)
        damaged |= set(unknown)
        if not damaged:
            found.rows = self._read_rows(records)
        digests: dict[str, str] = {}
        told = self._check_scenes(found, found.rows, digests) if found.rows is not None else []
        for files in entries:
            self._check_files([one for one in files if not is_table(one)], digests, damaged, found)
        self._tell_labels(found, told, damaged)
        return found

    def _entries(self, record: CommitRecord, unknown: list[str]) -> tuple[FileEntry, ...]:
        """The files of a commit, as far as they can be known; adds to `unknown` why there may be more."""
        try:
            return committed_files(self._store, record)
        except CorruptError as error:
            unknown.append(_without_remedy(error))
            return record.files

    def _check_files(
        self,
        entries: Sequence[FileEntry],
        digests: dict[str, str],
        damaged: set[str],
        found: ReadRange,
    ) -> None:
        """Tells of files that are missing or differ from their SHA-256. Reads those without a digest yet."""
        for entry in entries:
            known = self.index.add(entry.path, entry.sha256)
            if known is not None:
                if not is_shape(entry.path):
                    self.verdict.tell(f"{entry.path}: is named by two commits", COPY)
                if known == entry.sha256:
                    continue
            if fault := self._check_file(entry, digests, found):
                damaged.add(entry.path)
                self.verdict.tell(
                    f"{entry.path}: {fault}", self.verdict.make_again(found.records[0].span.start), "file"
                )

    def _check_file(self, entry: FileEntry, digests: dict[str, str], found: ReadRange) -> str | None:
        try:
            if entry.path not in digests:
                self._read(found, entry.path, digests)
        except FileNotFoundError:
            return "is committed and missing"
        except OSError as error:
            return f"is committed and {describe_os_error(error)}"
        return None if digests[entry.path] == entry.sha256 else "does not match the SHA-256 in its commit"

    def _read(self, found: ReadRange, path: str, digests: dict[str, str]) -> bytes:
        """A file of the range, published or not yet, counted and hashed. Raises FileNotFoundError."""
        try:
            data = self._store.read(path)
        except FileNotFoundError:
            data = self._read_staged(found, path)
        digests[path] = hashlib.sha256(data).hexdigest()
        self.verdict.files += 1
        self.verdict.bytes += len(data)
        return data

    def _read_staged(self, found: ReadRange, path: str) -> bytes:
        for record in found.records:
            with contextlib.suppress(CorruptError):
                data = read_committed(self._store, record, path)
                found.staged += 1
                return data
        raise FileNotFoundError(path)

    def _read_rows(self, records: tuple[CommitRecord, ...]) -> dict[str, pa.Table] | None:
        """The rows by table. None, which is told, where they cannot be read although their bytes are as committed."""
        try:
            return {table: range_rows(self._store, records, table) for table in TABLES}
        except (CorruptError, OSError) as error:
            self.verdict.tell(_without_remedy(error), COPY)
            return None

    def _check_scenes(
        self, found: ReadRange, tables: dict[str, pa.Table], digests: dict[str, str]
    ) -> list[tuple[int, str]]:
        """Counts the range's scenes, and derives every pair's labels again: (scene id, fault)."""
        rows = {table: tables[table].to_pylist() for table in DETERMINISTIC_TABLES}
        records, span = found.records, found.records[0].span
        stored = StoredRange(span.start, span.stop, records, rows)
        made = {row["scene_id"]: row for row in rows["scenes"]}
        ended = sorted([*made, *(row["scene_id"] for row in rows["failures"])])
        self.verdict.scenes += len(ended)
        if ended != list(span.scene_ids):
            what = f"{commit_path(span.start)}: some of its scenes {span.start} to {span.stop - 1} have no row, or two"
            self.verdict.tell(what, COPY)
        job = self._job
        if job is None or {record.terms.job_digest for record in records} != {self._job_digest}:
            return []
        faults: list[tuple[int, str]] = []

        def read_file(path: str) -> bytes:
            data = self._read(found, path, digests)
            if path.endswith(".tar"):
                off = check_labels(path.partition("/")[0], data, path, rows)
                faults.extend((pose_id // (2 * job.pairs_per_scene), fault) for pose_id, fault in off)
            return data

        try:
            read = file_reader(read_file, stored)
        except (CorruptError, OSError):
            return []  # the archive is told by its digest
        check_scene = self._check_scene
        if check_scene is None:
            return faults
        for scene_id, scene in made.items():
            faults += [(scene_id, fault) for fault in check_scene(job, stored, scene, read)]
            self.verdict.pairs += len({row["parent_id"] for row in rows["views"] if row["scene_id"] == scene_id})
        return faults

    def _tell_labels(self, found: ReadRange, told: list[tuple[int, str]], damaged: set[str]) -> None:
        """Tells of wrong labels, unless they follow from a damaged file, which is told already."""
        if not told or found.rows is None:
            return
        packed = any(path.endswith(".tar") for path in damaged)
        spoilt = {
            row["scene_id"]
            for row in found.rows["views"].select(["scene_id", "files"]).to_pylist()
            if packed or any(file["path"] in damaged for file in row["files"])
        }
        for scene_id, fault in told:
            if scene_id not in spoilt:
                remedy = f"its files are as committed; `verso replay {self.verdict.out} {scene_id}` makes it again and compares"
                self.verdict.tell(fault, remedy)


def is_table(entry: FileEntry) -> bool:
    """Whether a file of a commit is one of its tables."""
    return entry.path.startswith(f"{RANGES}/")


CheckScene = Callable[[Job, StoredRange, dict, ReadFile], list[str]]
"""Labels of one scene that do not follow from its images, rows and job, a sentence each."""


def _label_check() -> CheckScene:
    """Derives labels by the producer's functions. Raises MachineError where these are not installed."""
    with needs_making("deriving labels again"):
        from workers.scene.check_stored import check_stored_pair, check_stored_scene
        from workers.scene.context import keep_freed_memory
    keep_freed_memory()

    def check_scene(job: Job, stored: StoredRange, scene: dict, read: ReadFile) -> list[str]:
        faults, roles = check_stored_scene(scene), stored_roles(job)
        for views, objects in stored.pairs(scene["scene_id"]):
            if set(views) != set(roles):
                faults.append(f"scene {scene['scene_id']}: has views {sorted(views)}, and must have {sorted(roles)}")
                continue
            try:
                faults += check_stored_pair(job, views, objects, scene, partial(read_image, read))
            except (CorruptError, ValueError, OSError) as error:
                faults.append(f"scene {scene['scene_id']}: {error}")
        return faults

    return check_scene


def _without_remedy(error: Exception) -> str:
    """An error's sentence without the remedy at its end."""
    return str(error).partition(": restore it")[0]
