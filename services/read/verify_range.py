"""Committed ranges read back: which there must be, and of each its record, tables, files and labels."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from operator import itemgetter

import pyarrow as pa

from schemas.dataset.commit import CommitRecord, FileEntry
from schemas.dataset.layout import COMMITS, RANGES, commit_path, is_shape, parse_commit_name, stored_roles, view_name
from schemas.dataset.tables import DETERMINISTIC_TABLES, TABLES
from schemas.errors import CorruptError, command_line, needs_making
from schemas.job.job import Job
from services.merge.reading import PathTable
from services.read.dataset_reader import Members, ReadFile, StoredRange, committed_reader, file_reader
from services.read.verdict import COPY, MOST_FAULTS, Verdict, describe_os_error
from workers.store.commit import committed_files, read_record
from workers.store.images import decode_png
from workers.store.ledger import range_rows
from workers.store.store import Store
from workers.store.tars import check_labels, read_tar


def commit_groups(store: Store) -> list[tuple[int, list[int]]]:
    """(start, retries) of every range that has a commit record, in order. Other files are left to the search for strays."""
    files = (entry.key.removeprefix(f"{COMMITS}/") for entry in store.files(COMMITS, sizes=False))
    names = sorted(name for file in files if (name := parse_commit_name(file)) is not None)
    return [(start, [retry for _, retry in group]) for start, group in groupby(names, key=itemgetter(0))]


class Spans:
    """Takes ranges in order; knows the scenes that no range holds, and those whose commit or tables cannot be read."""

    def __init__(self, asked: tuple[int, int] | None, range_size: int, finished: bool, verdict: Verdict) -> None:
        self.asked = asked
        """First scene and stop; None where neither job.yaml nor `_SUCCESS` says it."""
        self.gaps: list[tuple[int, int]] = []
        self.unreadable: list[tuple[int, int]] = []
        """Scenes [start, stop) of damaged ranges."""
        self.done = 0
        """Committed scenes."""
        self.staged = 0
        """Files that are committed and not published."""
        self.range_size = range_size
        self._foreign = False
        """Whether scenes are committed twice, or outside of those asked."""
        self._finished = finished
        self.verdict = verdict
        self._stop = None if asked is None else asked[0]
        """Where the ranges taken so far end."""

    @property
    def fits(self) -> bool:
        """Whether the ranges taken so far can be merged; after the last, whether every scene asked is committed once."""
        return not (self.gaps or self.unreadable or self._foreign)

    def take(self, start: int, stop: int, readable: bool) -> None:
        """The scenes [start, stop) of the next range, and whether its records can be read."""
        if self._stop is not None and start > self._stop:
            self._tell_gap(self._stop, start)
        elif self._stop is not None and start < self._stop:
            self._foreign = True
            self.verdict.tell(f"{commit_path(start)}: scene {start} is committed twice", COPY)
        self._stop = stop
        if not readable:
            self.unreadable.append((start, stop))
            return
        self.done += stop - start
        if self.asked is not None and not self.asked[0] <= start < stop <= self.asked[1]:
            self._foreign = True
            what = f"{commit_path(start)}: scenes {start} to {stop - 1} are committed, outside of those asked"
            self.verdict.tell(what, f"{self.asked[0]} to {self.asked[1] - 1} are, by job.yaml or _SUCCESS; {COPY}")

    def finish(self) -> None:
        """After the last range."""
        if self.asked is not None and self._stop is not None and self._stop < self.asked[1]:
            self._tell_gap(self._stop, self.asked[1])

    def _tell_gap(self, start: int, stop: int) -> None:
        """Names each missing commit of a finished dataset, unless they are too many, and the scenes of an unfinished one."""
        self.gaps.append((start, stop))
        first = self.asked[0] if self.asked else start
        others = range(start + self.range_size - (start - first) % self.range_size, stop, self.range_size)
        starts = [start, *others] if self._finished and len(others) < MOST_FAULTS else [start]
        for begin, end in pairwise([*starts, stop]):
            commit = f"{commit_path(begin)}: is missing: " if self._finished else ""
            remedy = f"{self.verdict.run_again} to make them"
            self.verdict.tell(f"{commit}scenes {begin} to {end - 1} are not committed", remedy)


def read_records(store: Store, start: int, retries: Sequence[int], verdict: Verdict) -> tuple[CommitRecord, ...]:
    """The records of a range and its retries; empty where one of them is missing or damaged, which is told."""
    for retry in sorted(set(range(max(retries))) - set(retries)):
        verdict.tell(f"{commit_path(start, retry)}: is missing, and later tries of its range are there", COPY)
    records = []
    for retry in retries:
        key = commit_path(start, retry)
        try:
            records.append(read_record(store, start, retry))
        except CorruptError as error:
            fault = _without_remedy(error).removeprefix(key).lstrip(": ")
            verdict.tell(f"{key}: {fault}", verdict.make_again(start))
        except OSError as error:
            verdict.tell(f"{key}: {describe_os_error(error)}", COPY)
    whole = [record for record in records if record is not None]
    return tuple(whole) if len(whole) == len(retries) == max(retries) + 1 else ()


@dataclass(frozen=True)
class Reading:
    """What every range is read back with."""

    store: Store
    job: Job | None
    job_digest: str | None
    """Of the keys of job.yaml as they are: labels of commits of another job cannot be derived."""
    index: PathTable
    """Gets the path of every file that the ranges name."""
    verdict: Verdict


class ReadRange:
    """A range with its retries as it was found.

    `rows` are its rows by table, None where a table is not whole; `files` are the files of all its records; `staged` counts
    those that are committed and not in their final places yet.
    """

    def __init__(self, reading: Reading, records: tuple[CommitRecord, ...]) -> None:
        self.records = records
        self.files: tuple[FileEntry, ...] = ()
        self.rows: dict[str, pa.Table] | None = None
        self.staged = 0
        self._reading, self.verdict, self._start = reading, reading.verdict, records[0].span.start
        self._damaged: set[str] = set()
        self._digests: dict[str, str] = {}
        """SHA-256 of the files that were read, by path."""

    def check(self, check_scene: "CheckScene | None") -> None:
        """Reads every file once: tables first, then what labels are derived from, then the rest."""
        unknown: list[str] = []
        for record in self.records:
            try:
                self.files += committed_files(self._reading.store, record)
            except CorruptError as error:
                self.files += record.files
                unknown.append(_without_remedy(error))
        self._check_files([entry for entry in self.files if is_table(entry)])
        if unknown and not self._damaged:
            self.verdict.tell(unknown[0], COPY)
        elif not self._damaged:
            self.rows = self._read_rows()
        faults = self._check_scenes(self.rows, check_scene) if self.rows is not None else []
        self._check_files([entry for entry in self.files if not is_table(entry)])
        if self.rows is not None:
            self._tell_labels(self.rows, faults)

    def _check_files(self, entries: Sequence[FileEntry]) -> None:
        """Tells of files that are missing or differ from their SHA-256. Reads those that were not read yet."""
        for entry in entries:
            known = self._reading.index.get(entry.path)
            self._reading.index.add_all([(entry.path, entry.sha256)])
            if known is not None and not is_shape(entry.path):
                self.verdict.tell(f"{entry.path}: is named by two commits", COPY)
            if known != entry.sha256 and (fault := self._check_file(entry)):
                self._damaged.add(entry.path)
                self.verdict.tell(f"{entry.path}: {fault}", self.verdict.make_again(self._start), "file")

    def _check_file(self, entry: FileEntry) -> str | None:
        try:
            if entry.path not in self._digests:
                self._read(entry.path)
        except FileNotFoundError:
            return "is committed and missing"
        except OSError as error:
            return f"is committed and {describe_os_error(error)}"
        return None if self._digests[entry.path] == entry.sha256 else "does not match the SHA-256 in its commit"

    def _read(self, path: str) -> bytes:
        """A file of the range, published or not yet, counted and hashed. Raises FileNotFoundError."""
        try:
            data = self._reading.store.read(path)
        except FileNotFoundError:
            try:
                data = committed_reader(self._reading.store, self.records)(path)
            except CorruptError as error:
                raise FileNotFoundError(path) from error
            self.staged += 1
        self._digests[path] = hashlib.sha256(data).hexdigest()
        self.verdict.files += 1
        self.verdict.bytes += len(data)
        return data

    def _read_rows(self) -> dict[str, pa.Table] | None:
        """The rows by table. None, which is told, where they cannot be read although their bytes are as committed."""
        try:
            return {table: range_rows(self._reading.store, self.records, table) for table in TABLES}
        except (CorruptError, OSError) as error:
            self.verdict.tell(_without_remedy(error), COPY)
            return None

    def _check_scenes(self, tables: dict[str, pa.Table], check_scene: "CheckScene | None") -> list[tuple[int, str]]:
        """Counts the range's scenes, and derives every pair's labels again: (scene id, fault)."""
        rows = {table: tables[table].to_pylist() for table in DETERMINISTIC_TABLES}
        made, span = {row["scene_id"]: row for row in rows["scenes"]}, self.records[0].span
        ended = sorted([*made, *(row["scene_id"] for row in rows["failures"])])
        self.verdict.scenes += len(ended)
        if ended != list(span.scene_ids):
            what = f"{commit_path(span.start)}: some of its scenes {span.start} to {span.stop - 1} have no row, or two"
            self.verdict.tell(what, COPY)
        job, digests = self._reading.job, {record.terms.job_digest for record in self.records}
        if job is None or digests != {self._reading.job_digest}:
            return []
        stored, faults = StoredRange(span.start, span.stop, self.records, rows), list[tuple[int, str]]()

        tars: dict[str, Members] = {}
        for path in (entry.path for record in self.records for entry in record.files if entry.path.endswith(".tar")):
            try:
                category, data = path.partition("/")[0], self._read(path)
                tars[path] = dict(read_tar(category, data, path))
            except (CorruptError, OSError):
                return []  # the archive is told by its digest
            wrong = check_labels(category, data, path, rows)
            faults += [(pose_id // (2 * job.pairs_per_scene), fault) for pose_id, fault in wrong]
        if check_scene is None:
            return faults
        read = file_reader(self._read, self.records, tars)
        for scene_id, scene in made.items():
            faults += [(scene_id, fault) for fault in check_scene(job, stored, scene, read)]
            self.verdict.pairs += len({row["parent_id"] for row in rows["views"] if row["scene_id"] == scene_id})
        return faults

    def _tell_labels(self, rows: dict[str, pa.Table], faults: list[tuple[int, str]]) -> None:
        """Tells of wrong labels, unless they follow from a damaged file, which is told already."""
        packed = any(path.endswith(".tar") for path in self._damaged)
        spoilt = {
            row["scene_id"]
            for row in (rows["views"].select(["scene_id", "files"]).to_pylist() if faults else ())
            if packed or any(file["path"] in self._damaged for file in row["files"])
        }
        for scene_id, fault in faults:
            if scene_id not in spoilt:
                again = f"`{command_line('replay', self.verdict.out, scene_id)}` makes it again and compares"
                self.verdict.tell(fault, f"its files are as committed; {again}")


def is_table(entry: FileEntry) -> bool:
    """Whether a file of a commit is one of its tables."""
    return entry.path.startswith(f"{RANGES}/")


CheckScene = Callable[[Job, StoredRange, dict, ReadFile], list[str]]
"""Labels of one scene that do not follow from its images, rows and job, a sentence each."""


def wrong_views(job: Job, views: Mapping[str, dict], first: bool) -> str:
    """How the views of a pair, by name, are not those that the job asks for; empty where they are. `first`: of its scene."""
    expected, found = set(stored_roles(job)), set(views)
    for entry in job.cameras.more if first else [each for each in job.cameras.more if each.beside]:
        own = {name for name in found if views[name]["role"] == entry.name}
        numbers = range(len(own) if entry.count is None else entry.count)
        expected |= {view_name(entry.name, number) for number in numbers}
    if not (wrong := sorted(expected ^ found)):
        return ""
    return f"has {len(found)} views, and {len(expected)} are asked for: {', '.join(wrong[:5])} should be there, or should not"


def find_label_check() -> CheckScene:
    """Derives labels by the producer's functions. Raises MachineError where these are not installed."""
    with needs_making("deriving labels again"):
        from workers.scene.check_stored import check_stored_pair, check_stored_scene
        from workers.scene.context import keep_freed_memory
    keep_freed_memory()

    def check_scene(job: Job, stored: StoredRange, scene: dict, read: ReadFile) -> list[str]:
        faults = check_stored_scene(scene)
        for pair_number, (views, objects) in enumerate(stored.pairs(scene["scene_id"])):
            if fault := wrong_views(job, views, pair_number == 0):
                faults.append(f"scene {scene['scene_id']}: {fault}")
                continue
            try:
                faults += check_stored_pair(job, views, objects, scene, lambda path: decode_png(read(path), path))
            except (CorruptError, ValueError, OSError) as error:
                faults.append(f"scene {scene['scene_id']}: {error}")
        return faults

    return check_scene


def _without_remedy(error: Exception) -> str:
    """An error's sentence without the remedy at its end."""
    return str(error).partition(": restore it")[0]
