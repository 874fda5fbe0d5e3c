"""One attempt at a range, from its first file to its commit, and the sweep of what attempts left in `_staging/`.

An attempt's files go to staging at once; its rows stay in memory until the commit. A sweep publishes winners, removes losers
and leaves attempts alone that may still win.
"""

import contextlib
import json
import os
import re
import socket
import uuid
from collections.abc import Collection, Iterator, Mapping
from operator import attrgetter

import pyarrow as pa

from schemas.dataset.commit import (
    COMMIT_VERSION,
    MARK,
    CommitRecord,
    CommitResult,
    CommitTerms,
    FileEntry,
    SceneMark,
    Span,
    foreign_path,
)
from schemas.dataset.layout import (
    COMMITS,
    FENCED,
    JOB_FILE,
    LOCK_CLAIMS,
    PROBE_PREFIX,
    STAGING,
    SUCCESS_FILE,
    TEMPORARY,
    commit_path,
    is_shape,
    parse_range_name,
    range_table_path,
    staging_path,
)
from schemas.dataset.shard import JobChange
from schemas.dataset.tables import TABLES
from schemas.errors import CorruptError, OutputError, RunError
from schemas.scene.scene import EncodedFile, SceneOutput, encoded_file
from workers.store.commit import committed_files, compare_attempts, encode_record, publish, read_record
from workers.store.manifest import (
    check_files,
    encode_table,
    files_of_assets,
    join_rows,
    outcome_of,
    scene_digest,
    sorted_rows,
    table_of_rows,
    with_shape_files,
)
from workers.store.store import Store, is_live
from workers.store.tars import Packing

CURRENT = "_current"
"""A file in an attempt's folder that names the scene in progress, in case the worker dies."""

_NOTE_BYTES = 64
"""Of every note, so that one replaces the other in place: more than the largest scene id needs."""

TIMED_OUT = "_timed_out"
"""The file there that holds the traceback of a worker that hung in a scene."""

_NAME = re.compile(r"r([0-9]{1,9})-.+")


def begin_attempt(store: Store, span: Span, terms: CommitTerms, label: str = "") -> "Attempt":
    """A new attempt at `span` with a folder of its own.

    `label` becomes part of its name, by which the coordinator knows its own attempts. Raises OutputError where the store
    cannot hold the layout.
    """
    if terms.layout not in store.layouts:
        raise OutputError(
            f"{store.name} is an object store, which needs output.layout: tar; the job says {terms.layout}"
        )
    host = host_part(socket.gethostname())
    name = "-".join(part for part in (f"r{span.retry}", label, host, str(os.getpid()), uuid.uuid4().hex[:12]) if part)
    return Attempt(store, span, terms, name)


def host_part(host: str) -> str:
    """A host's name as a part of an attempt's name, where `-` separates parts."""
    return re.sub(r"[^A-Za-z0-9_.]", "_", host)


def reopen(store: Store, job_change: JobChange | None = None) -> None:
    """Makes a finished dataset an unfinished one, just before it gets another commit. Anyone may, any number of times."""
    with contextlib.suppress(FileNotFoundError):
        if job_change is not None and store.read(JOB_FILE) == job_change.before.encode():
            store.put(JOB_FILE, job_change.after.encode())
    if store.size(SUCCESS_FILE) is not None:
        store.remove(SUCCESS_FILE)
        store.sync([SUCCESS_FILE])


def retry_of_attempt(name: str) -> int | None:
    """Which retry an attempt's folder belongs to (0: the range itself); None where it is not an attempt's name."""
    match = _NAME.fullmatch(name)
    return int(match[1]) if match else None


def attempts_at(store: Store, start: int) -> list[str]:
    """Names of the attempts that have a folder for the range at `start`, except fenced ones."""
    names = [name for name in store.children(staging_path(start, "")[:-1]) if not name.endswith(FENCED)]
    return [n for n in names if retry_of_attempt(n) is not None and is_live(store, staging_path(start, n))]


def staged_attempts(store: Store) -> Iterator[tuple[int, str]]:
    """(start of its range, name) of every attempt that has a folder and is not fenced."""
    for folder in store.children(STAGING):
        if (start := parse_range_name(folder)) is not None:
            yield from ((start, name) for name in attempts_at(store, start))


def blamed_scene(store: Store, start: int, attempt: str) -> int | None:
    """The scene that an attempt last noted as in progress; None where it was between scenes or is gone."""
    try:
        scene_id = json.loads(store.read(f"{staging_path(start, attempt)}/{CURRENT}"))["scene_id"]
    except (FileNotFoundError, ValueError, LookupError, TypeError):
        return None
    return scene_id if isinstance(scene_id, int) else None


class Attempt:
    """An attempt at one range. Nothing outside its own folder changes before `commit`."""

    def __init__(self, store: Store, span: Span, terms: CommitTerms, name: str) -> None:
        self.name = name
        self.span = span
        self.fenced = False
        """True once the folder was swept: the attempt can still be compared, but no longer win."""
        self._store = store
        self._terms = terms
        self._stage = store.stage(staging_path(span.start, name))
        self._files: dict[str, FileEntry] = {}
        self._rows: dict[str, list[pa.Table]] = {table: [] for table in TABLES}
        self._scenes: list[SceneMark] = []
        self._packing = Packing(self._stage, span, tar=terms.layout == "tar")
        self._noted: Mapping[str, object] | None = None

    def begin_scene(self, scene_id: int) -> None:
        """Notes the scene in progress, which is blamed if the worker dies."""
        self._note({"scene_id": scene_id})

    def add_scene(self, output: SceneOutput) -> None:
        """Writes a scene's files and keeps its rows.

        Raises ValueError where the output breaks the schema, its rows and files disagree, it is neither made nor failed,
        or it is not the next scene of the range.
        """
        awaited = self.span.scene_ids[len(self._scenes) :][:1]
        if (output.scene_id,) != awaited:
            raise ValueError(f"scene {output.scene_id} came, and the range from {self.span.start} awaits {awaited}")
        tables = {table: table_of_rows(table, output.rows.get(table, ())) for table in TABLES}
        if unknown := output.rows.keys() - tables.keys():
            raise ValueError(f"scene {output.scene_id} has rows for unknown tables: {', '.join(sorted(unknown))}")
        outcome = outcome_of(output)
        entries = {file.path: _entry_of(file) for file in output.files}
        check_files(output, entries)
        if differing := [path for path in self._files.keys() & entries.keys() if self._files[path] != entries[path]]:
            raise ValueError(f"{differing[0]} was written twice with different bytes")
        new = {file.path: file.data for file in output.files if file.path not in self._files}
        with self._skip_if_swept():
            self._packing.add(new, tables)
        self._files |= entries
        for table, rows in tables.items():
            self._rows[table].append(rows)
        reason = None if outcome == "made" else str(output.rows["failures"][0]["reason"])
        digest = scene_digest(output.rows)[:MARK]
        self._scenes.append(SceneMark(scene_id=output.scene_id, outcome=outcome, digest=digest, reason=reason))

    def end_scenes(self) -> None:
        """Notes that no scene is in progress any more. Raises ValueError where a scene of the range is missing."""
        if missing := self.span.scene_ids[len(self._scenes) :]:
            first = list(missing[:5])
            raise ValueError(f"the range from {self.span.start} lacks scenes {first}: it cannot be committed")
        self._note({})

    def commit(self, job_change: JobChange | None = None) -> CommitResult:
        """Decides the range and, where this attempt wins, publishes it; a loser's folder is removed.

        Just before the decision, `_SUCCESS` goes and job.yaml is changed: an attempt that fails earlier leaves both.
        Raises ValueError where a scene of the range is missing or a file is not its own, RunError where the attempt was
        swept although nobody has committed the range.
        """
        self.end_scenes()
        record = self._finish()
        written = self._files_of(record)
        if not self._put(record, job_change):
            return self._concede(record)
        publish(self._store, record, written)
        return CommitResult(won=True, record=record)

    def abandon(self) -> None:
        """Removes the attempt's folder."""
        self._packing.close()
        self._stage.close()
        self._store.remove_tree(staging_path(self.span.start, self.name))

    def _finish(self) -> CommitRecord:
        """The record of this attempt, after the last of its files is written."""
        tables, entries = {}, []
        for table in TABLES:
            rows = sorted_rows(table, join_rows(table, self._rows[table]).combine_chunks())
            tables[table] = rows.num_rows
            if table == "assets":
                rows = with_shape_files(rows, self._files)
                listed = {entry.path for entry in files_of_assets(rows)}
                entries += [entry for path, entry in self._files.items() if is_shape(path) and path not in listed]
            file = encoded_file(range_table_path(self.span.start, table, self.span.retry), encode_table(rows))
            with self._skip_if_swept():
                self._stage.write(file.path, file.data)
            entries.append(_entry_of(file))
        with self._skip_if_swept():
            entries += self._packing.finish()
        return CommitRecord(
            schema_version=COMMIT_VERSION,
            span=self.span,
            attempt=self.name,
            terms=self._terms,
            files=tuple(sorted(entries, key=attrgetter("path"))),
            tables=tables,
            scenes=tuple(self._scenes),
        )

    def _files_of(self, record: CommitRecord) -> list[FileEntry]:
        """Every file that this attempt wrote, as `committed_files` has them. Raises ValueError naming one of another range."""
        listed = [entry for path, entry in self._files.items() if self._terms.layout == "files" or is_shape(path)]
        if (foreign := foreign_path(listed, self.span, self._terms.pairs_per_scene)) is not None:
            raise ValueError(f"{foreign!r} is not a file of the range from scene {self.span.start}")
        return sorted({*record.files, *listed}, key=attrgetter("path"))

    def _put(self, record: CommitRecord, job_change: JobChange | None) -> bool:
        """Puts the record if absent; True where it is now this attempt's."""
        key = commit_path(self.span.start, self.span.retry)
        with self._skip_if_swept():
            if not self.fenced and self._store.size(key) is None:
                self._stage.flush()
                reopen(self._store, job_change)
                return self._stage.put_if_absent(key, encode_record(record))
        return False

    def _concede(self, mine: CommitRecord) -> CommitResult:
        winner = read_record(self._store, self.span.start, self.span.retry)
        self.abandon()
        if winner is None:
            raise RunError(
                f"attempt {self.name} at the range from scene {self.span.start} was swept before it could commit: "
                "another coordinator works on this folder; stop one of them, and start again"
            )
        theirs = committed_files(self._store, winner)
        return CommitResult(False, winner, compare_attempts(mine, self._files.values(), winner, theirs))

    def _note(self, current: Mapping[str, object]) -> None:
        """Writes what is in progress, unless it is what was written last."""
        if current != self._noted:
            with self._skip_if_swept():
                self._stage.write(CURRENT, json.dumps(current).encode().ljust(_NOTE_BYTES))
            self._noted = current

    @contextlib.contextmanager
    def _skip_if_swept(self) -> Iterator[None]:
        """Skips a write to a folder that was swept."""
        try:
            yield
        except FileNotFoundError:
            self.fenced = True


def _entry_of(file: EncodedFile) -> FileEntry:
    return FileEntry(path=file.path, bytes=len(file.data), sha256=file.sha256)


def sweep(store: Store, fenced: Collection[tuple[int, str]] | None = ()) -> list[str]:
    """Publishes committed ranges and removes staging that lost; returns the attempts removed.

    Attempts at ranges that are not committed stay, except those in `fenced`, pairs of (start, attempt) whose workers are
    believed to be dead. None means all of them, and the files of a merge that was killed: for a coordinator that holds
    the lock and has no worker yet.
    """
    removed = []
    for folder in store.children(STAGING):
        path, start = f"{STAGING}/{folder}", parse_range_name(folder)
        if start is not None:
            for name in store.children(path):
                attempt = name.removesuffix(FENCED)
                given_up = name.endswith(FENCED) or fenced is None or (start, attempt) in fenced
                if sweep_attempt(store, start, attempt, given_up):
                    removed.append(attempt)
            store.remove_empty(path)
        elif fenced is None and path not in (TEMPORARY, LOCK_CLAIMS):
            store.remove_tree(path)
    for entry in [*store.files(COMMITS, sizes=False), *store.files(TEMPORARY)]:
        if entry.key.startswith((f"{COMMITS}/{PROBE_PREFIX}", TEMPORARY)):
            store.remove(entry.key)  # a living process writes its temporary file again
    return removed


def sweep_attempt(store: Store, start: int, attempt: str, given_up: bool) -> bool:
    """Publishes or removes one attempt's folder; True where it was removed.

    An attempt at a range that is not committed is removed only where it is `given_up`, and only after it was fenced:
    should it be alive, it cannot commit any more. A store where it still may (`revoke`) keeps its files until another attempt
    has committed the range.
    """
    staging = staging_path(start, attempt)
    retry = retry_of_attempt(attempt)
    if retry is None:
        raise CorruptError(f"{staging} is not an attempt of this program: move it away")
    final = True
    if store.size(commit_path(start, retry)) is None:
        if not given_up:
            return False
        final = store.revoke(staging)
    record = read_record(store, start, retry)
    if record is not None and record.attempt == attempt:
        publish(store, record)
        return False
    if record is None and not final:
        return False
    for folder in (staging, staging + FENCED):
        store.remove_tree(folder)
    return True
