"""Files of a committed range made again from the job, and kept only where their SHA-256 is what the commit says."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord, FileEntry, SceneMark
from schemas.dataset.layout import MANIFEST, RANGES, is_shape, pose_of_image, range_table_path
from schemas.errors import CorruptError
from schemas.scene.scene import SceneOutput
from services.job.record import JobRecord
from services.read.replay import open_context
from services.read.stored_tables import read_merged
from workers.pipeline.context import WorkerContext
from workers.pipeline.run_shard import run_scene
from workers.pipeline.stopwatch import Stopwatch
from workers.store.attempt import begin_attempt
from workers.store.commit import read_committed
from workers.store.file_system import temporary_folder
from workers.store.local import LocalStore
from workers.store.manifest import decode_table, encode_table, sorted_rows, table_of_rows
from workers.store.store import Store


class Maker:
    """Makes scenes of a stored job again. The process is prepared for them at the first one."""

    def __init__(self, store: Store, job: JobRecord) -> None:
        self._store = store
        self._job = job
        self._context: WorkerContext | None = None

    def make_files(self, record: CommitRecord, lost: Sequence[FileEntry]) -> Iterator[tuple[str, bytes]]:
        """(path, bytes) of those files that come out as the record says. Raises MachineError where the assets changed."""
        awaited = {entry.path: entry.sha256 for entry in lost}
        for path, data in self._make(record, awaited):
            if awaited.get(path) == hashlib.sha256(data).hexdigest():
                del awaited[path]
                yield path, data

    def _make(self, record: CommitRecord, awaited: Mapping[str, str]) -> Iterator[tuple[str, bytes]]:
        """(path, bytes) of files that may be those awaited, until none is: the cheapest first."""
        known = {table: self._known_rows(record, table) for table in ("timings", "failures")}
        for table, rows in known.items():
            path = range_table_path(record.span.start, table, record.span.retry)
            if path in awaited:
                yield path, encode_table(sorted_rows(table, table_of_rows(table, list(rows.values()))))
        made = [path for path in awaited if not path.endswith("/timings.parquet")]
        if any(path.startswith(f"{RANGES}/") or path.endswith(".tar") for path in made):
            yield from self._make_range(record, awaited, known)
        elif made:
            yield from self._make_scenes(record, awaited)

    def _make_scenes(self, record: CommitRecord, awaited: Mapping[str, str]) -> Iterator[tuple[str, bytes]]:
        """The files of the scenes that may hold those awaited: of their own scenes, of all for shapes."""
        poses = 2 * self._job.job.pairs_per_scene
        own = {pose // poses for path in awaited if (pose := pose_of_image(path)) is not None}
        shapes = any(is_shape(path) for path in awaited)
        for mark in record.scenes:
            if mark.outcome == "made" and (shapes or mark.scene_id in own):
                for file in self._run(mark.scene_id).files:
                    yield file.path, file.data
            if not awaited:
                return

    def _make_range(
        self, record: CommitRecord, awaited: Mapping[str, str], known: Mapping[str, Mapping[int, Row]]
    ) -> Iterator[tuple[str, bytes]]:
        """The files of the whole range, committed in a temporary folder by the code that commits every range."""
        with temporary_folder("repair") as folder:
            scratch = LocalStore(folder)
            scratch.prepare()
            attempt = begin_attempt(scratch, record.span, record.terms)
            for mark in record.scenes:
                attempt.begin_scene(mark.scene_id)
                attempt.add_scene(self._output(mark, known))
            attempt.commit()
            for path in list(awaited):
                file = folder / path
                if file.is_file():
                    yield path, file.read_bytes()

    def _output(self, mark: SceneMark, known: Mapping[str, Mapping[int, Row]]) -> SceneOutput:
        """A scene made again, with the times that were measured first; a killed one as it was recorded."""
        failed, measured = (known[table].get(mark.scene_id) for table in ("failures", "timings"))
        if mark.outcome != "environmental":
            output = self._run(mark.scene_id)
        elif failed is None:
            raise CorruptError(f"nothing tells any more why scene {mark.scene_id} failed")
        else:
            output = SceneOutput(mark.scene_id, (), {"failures": [failed]})
        return replace(output, rows={**output.rows, "timings": [measured]}) if measured else output

    def _known_rows(self, record: CommitRecord, table: str) -> dict[int, Row]:
        """Rows that cannot be made again, by scene: from the range's own table, or from the merged one."""
        path = range_table_path(record.span.start, table, record.span.retry)
        awaited = {entry.path: entry.sha256 for entry in record.files}
        try:
            data = read_committed(self._store, record, path)
            if hashlib.sha256(data).hexdigest() == awaited.get(path):
                return {row["scene_id"]: row for row in decode_table(table, data, path).to_pylist()}
        except (CorruptError, OSError):
            pass
        return self._merged_rows(record, table)

    def _merged_rows(self, record: CommitRecord, table: str) -> dict[int, Row]:
        """Rows of merged files that can still be read; whether they are right is for their SHA-256 to say."""
        found: dict[int, Row] = {}
        for entry in sorted(self._store.files(f"{MANIFEST}/{table}")):
            try:
                rows = read_merged(table, entry.key, self._store.read(entry.key))
            except (pa.ArrowException, OSError, ValueError, KeyError):
                continue
            wanted = pc.is_in(rows.column("scene_id"), value_set=pa.array(record.span.scene_ids, pa.int64()))
            found |= {row["scene_id"]: row for row in rows.filter(wanted).to_pylist()}
        return found

    def _run(self, scene_id: int) -> SceneOutput:
        if self._context is None:
            self._context = open_context(self._job)
        return run_scene(self._context, scene_id, Stopwatch())
