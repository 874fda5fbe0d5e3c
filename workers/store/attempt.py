"""One try at a range: files go to staging at once, rows gather in memory, and the commit decides."""

import contextlib
import hashlib
import json
import os
import re
import socket
import uuid
from collections.abc import Iterator, Mapping

import pyarrow as pa

from schemas.commit import CommitRecord, CommitResult, CommitTerms, FileEntry, Outcome, SceneMark, Span, TableEntry
from schemas.errors import OutputError, RunError
from schemas.layout import ASSETS, commit_path, range_table_path, staging_path
from schemas.manifest import DETERMINISTIC_TABLES, SCHEMA_VERSION, SCHEMAS, TABLES
from schemas.scene import SceneOutput
from workers.store.canonical import joint_digest, rows_digest
from workers.store.commit import compare_records, encode_record, publish, read_record
from workers.store.manifest import encode_table, sorted_rows, table_of_rows
from workers.store.packing import FilePacking, Packing, TarPacking
from workers.store.store import Store

CURRENT = "_current"
"""In an attempt's folder: which scene it is working on, for whoever finds the worker dead."""

_NAME = re.compile(r"r(\d+)-.+")
_UNSAFE = re.compile(r"[\x00-\x1f\x7f\\]")


def begin_attempt(store: Store, span: Span, terms: CommitTerms, label: str = "") -> "Attempt":
    """A new attempt at `span` with a folder of its own.

    `label` goes into its name, so that whoever started it can recognise it. Raises OutputError where the store cannot
    hold the layout.
    """
    if store.tar_only and terms.layout != "tar":
        raise OutputError(
            f"{store.name} is an object store, which needs output.layout: tar; the job says {terms.layout}"
        )
    host = re.sub(r"[^A-Za-z0-9_.]", "_", socket.gethostname())
    name = "-".join(part for part in (f"r{span.retry}", label, host, str(os.getpid()), uuid.uuid4().hex[:12]) if part)
    store.open_staging(staging_path(span.start, name))
    return Attempt(store, span, terms, name)


def retry_of_attempt(name: str) -> int | None:
    """Which retry an attempt's folder belongs to (0: the range itself); None where it is not an attempt's name."""
    match = _NAME.fullmatch(name)
    return int(match[1]) if match else None


def attempts_at(store: Store, start: int) -> list[str]:
    """Names of the attempts that have a folder for the range at `start`, fenced ones left out."""
    names = store.children(staging_path(start, "")[:-1])
    return [name for name in names if retry_of_attempt(name) is not None and not name.endswith(".fenced")]


def blamed_scene(store: Store, start: int, attempt: str) -> int | None:
    """The scene that an attempt was working on when it last said so; None where it was between scenes or is gone."""
    try:
        current = json.loads(store.read(f"{staging_path(start, attempt)}/{CURRENT}"))
    except (FileNotFoundError, ValueError):
        return None
    scene_id = current.get("scene_id") if isinstance(current, dict) else None
    return scene_id if isinstance(scene_id, int) else None


class Attempt:
    """A try at one range. Nothing outside its own folder changes before `commit`."""

    def __init__(self, store: Store, span: Span, terms: CommitTerms, name: str) -> None:
        self.name = name
        self.span = span
        self.fenced = False
        """True once the folder was swept away: the attempt can still compare, and no longer win."""
        self._store = store
        self._terms = terms
        self._staging = staging_path(span.start, name)
        self._files: dict[str, FileEntry] = {}
        self._rows: dict[str, list[pa.Table]] = {table: [SCHEMAS[table].empty_table()] for table in TABLES}
        self._scenes: dict[int, SceneMark] = {}
        packing = TarPacking if terms.layout == "tar" else FilePacking
        self._packing: Packing = packing(store, self._staging, span)

    def begin_scene(self, scene_id: int) -> None:
        """Notes the scene being worked on, so that it can be blamed should the worker die in it."""
        self._note({"scene_id": scene_id})

    def add_scene(self, output: SceneOutput) -> None:
        """Writes a scene's files and keeps its rows.

        Raises ValueError where the output breaks the schema, names files that its rows do not (or the other way round),
        is neither made nor failed, or is not the next of the range.
        """
        awaited = self.span.scene_ids[len(self._scenes) :][:1]
        if (output.scene_id,) != awaited:
            raise ValueError(f"scene {output.scene_id} came, and the range from {self.span.start} awaits {awaited}")
        tables = {table: table_of_rows(table, output.rows.get(table, ())) for table in TABLES}
        if unknown := output.rows.keys() - tables.keys():
            raise ValueError(f"scene {output.scene_id} has rows for unknown tables: {', '.join(sorted(unknown))}")
        outcome = _outcome(output.scene_id, tables)
        entries = {path: FileEntry(path=path, bytes=len(data), sha256=_sha256(data)) for path, data in output.files}
        _check_files(output, tables["views"], entries)
        for path in self._files.keys() & entries.keys():
            if self._files[path] != entries[path]:
                raise ValueError(f"{path} was written twice with different bytes")
        with self._while_ours():
            self._packing.add({path: data for path, data in output.files if path not in self._files})
        self._files |= entries
        for table, rows in tables.items():
            self._rows[table].append(rows)
        self._scenes[output.scene_id] = SceneMark(
            scene_id=output.scene_id, outcome=outcome, digest=_scene_digest(tables)
        )

    def commit(self) -> CommitResult:
        """Decides the range and, where this attempt wins, publishes it; a loser's folder is dropped.

        Raises ValueError where a scene of the range is missing, RunError where the attempt was swept although nobody
        has committed the range.
        """
        missing = [scene_id for scene_id in self.span.scene_ids if scene_id not in self._scenes]
        if missing:
            raise ValueError(f"the range from {self.span.start} lacks scenes {missing[:5]}: it cannot be committed")
        self._note({})
        record = self._finish()
        if not self._put(record):
            return self._lose(record)
        publish(self._store, record)
        return CommitResult(won=True, record=record)

    def abandon(self) -> None:
        """Drops the attempt's folder."""
        self._packing.close()
        self._store.remove_tree(self._staging)

    def _finish(self) -> CommitRecord:
        """The record of this attempt, with all that it names written."""
        tables, files = {}, {}
        for table in TABLES:
            rows = sorted_rows(table, _distinct(table, pa.concat_tables(self._rows[table]).combine_chunks()))
            data = encode_table(rows)
            path = range_table_path(self.span.start, table, self.span.retry)
            with self._while_ours():
                self._store.write_staged(self._staging, path, data)
            files[path] = FileEntry(path=path, bytes=len(data), sha256=_sha256(data))
            tables[table] = TableEntry(rows=rows.num_rows, digest=rows_digest(table, rows))
        with self._while_ours():
            files |= {entry.path: entry for entry in self._packing.finish(self._files)}
        return CommitRecord(
            schema_version=SCHEMA_VERSION,
            span=self.span,
            attempt=self.name,
            terms=self._terms,
            files=tuple(files[path] for path in sorted(files)),
            tables=tables,
            scenes=tuple(self._scenes[scene_id] for scene_id in self.span.scene_ids),
        )

    def _put(self, record: CommitRecord) -> bool:
        """Whether this attempt's record now stands."""
        key = commit_path(self.span.start, self.span.retry)
        if self.fenced or self._store.size(key) is not None:
            return False
        won = False
        with self._while_ours():
            self._store.make_durable(self._staging)
            won = self._store.put_if_absent(key, encode_record(record), self._staging)
        return won

    def _lose(self, mine: CommitRecord) -> CommitResult:
        winner = read_record(self._store, self.span.start, self.span.retry)
        self.abandon()
        if winner is None:
            raise RunError(
                f"attempt {self.name} at the range from scene {self.span.start} was swept before it could commit: "
                "another coordinator works on this folder; stop one of them, and start again"
            )
        return CommitResult(won=False, record=winner, conflict=compare_records(mine, winner))

    def _note(self, current: Mapping[str, object]) -> None:
        with self._while_ours():
            self._store.write_staged(self._staging, CURRENT, json.dumps(current).encode())

    @contextlib.contextmanager
    def _while_ours(self) -> Iterator[None]:
        """Skips a write to a folder that was swept away."""
        try:
            yield
        except FileNotFoundError:
            self.fenced = True


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _outcome(scene_id: int, tables: Mapping[str, pa.Table]) -> Outcome:
    """How the scene ended. Raises ValueError unless its rows say exactly one thing, about this scene only."""
    for table, rows in tables.items():
        if "scene_id" in rows.column_names and set(rows.column("scene_id").to_pylist()) - {scene_id}:
            raise ValueError(f"scene {scene_id} has rows of another scene in {table}")
    made, failed = tables["scenes"].num_rows, tables["failures"].num_rows
    if made + failed != 1 or tables["timings"].num_rows > 1:
        raise ValueError(
            f"scene {scene_id} has {made} rows in scenes and {failed} in failures, and must have one in all"
        )
    if made:
        return "made"
    if extra := [table for table in ("views", "objects", "assets") if tables[table].num_rows]:
        raise ValueError(f"scene {scene_id} failed and has rows in {', '.join(extra)}")
    kind = tables["failures"].column("kind")[0].as_py()
    if kind not in ("intrinsic", "environmental"):
        raise ValueError(f"scene {scene_id} failed with the unknown kind {kind!r}")
    return kind


def _check_files(output: SceneOutput, views: pa.Table, entries: Mapping[str, FileEntry]) -> None:
    """Raises ValueError unless the rows of `views` and the files agree: paths, sizes, digests, each path once."""
    if len(entries) != len(output.files):
        raise ValueError(f"scene {output.scene_id} writes a path twice")
    for path in entries:
        if _UNSAFE.search(path) or any(part in ("", ".", "..") for part in path.split("/")) or path[0] in "_.":
            raise ValueError(f"{path!r} is not a path that a scene may write")
    named = [file for files in views.column("files").to_pylist() for file in files]
    images = {path: entry.model_dump() for path, entry in entries.items() if not path.startswith(f"{ASSETS}/")}
    if len({file["path"] for file in named}) != len(named) or {file["path"]: file for file in named} != images:
        wrong = sorted({file["path"] for file in named}.symmetric_difference(images)) or [
            "sizes, digests or repetitions"
        ]
        raise ValueError(f"scene {output.scene_id}: files and the rows of views disagree about {', '.join(wrong[:5])}")


def _distinct(table: str, rows: pa.Table) -> pa.Table:
    """Rows of `assets` once each, where scenes share them; other tables as they are.

    Two rows of one asset that differ stay, and are refused as a repeated key.
    """
    if table != "assets" or rows.num_rows < 2:
        return rows
    seen: dict[str, int] = {}
    for index, row in enumerate(rows.to_pylist()):
        seen.setdefault(json.dumps(row), index)
    return rows.take(list(seen.values()))


def _scene_digest(tables: Mapping[str, pa.Table]) -> str:
    names = [table for table in DETERMINISTIC_TABLES if table != "assets" and tables[table].num_rows]
    return joint_digest([(table, rows_digest(table, sorted_rows(table, tables[table]))) for table in names])
