"""One scene of a job, made in this process and kept in memory: no Ray, no folder."""

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from schemas.errors import CorruptError, SceneError
from schemas.job.job import Job
from schemas.job.views import Patch
from schemas.scene.scene import SceneOutput
from services.dataset.dataset import iter_pairs
from services.dataset.pair import Pair
from services.dataset.shapes import Shapes
from services.job.job_file import change_key, load_job, validate_job
from services.job.record import JobRecord, record_job
from workers.capture.results import open_sources
from workers.scene.context import Stopwatch, open_worker
from workers.shard.run_shard import run_scene
from workers.store.manifest import table_of_rows


def make_scene(
    job: str | Path | Mapping[str, Any] | Job, scene_id: int, changes: Sequence[str] = ()
) -> tuple[Pair, ...]:
    """The pairs of one scene, the same to the byte as a run of the job stores them.

    `job`: a job file, or its keys, or a Job, with `changes` such as "start.pose=tumbled". Relative folders start from the job
    file, else from here. The first call of a process prepares the renderer. Raises JobError where the job is wrong,
    SceneError where this scene cannot be made.
    """
    parsed, folder = _parse(job, changes)
    catalogue = open_sources(parsed, folder)
    output = run_scene(open_worker(parsed, catalogue), scene_id, Stopwatch())
    for row in output.rows.get("failures", ()):
        raise SceneError(str(row["reason"]), f"scene {scene_id} cannot be made ({row['stage']}): {row['detail']}")
    files = _MadeFiles(output, record_job(parsed, catalogue.digest, folder))
    return tuple(iter_pairs(lambda table: table_of_rows(table, output.rows[table]), files))


def _parse(job: str | Path | Mapping[str, Any] | Job, changes: Sequence[str]) -> tuple[Job, Path]:
    """The job, and the folder that its relative paths start from."""
    if isinstance(job, str | Path):
        return load_job(Path(job), changes), Path(job).parent
    tree = job.model_dump(mode="json") if isinstance(job, Job) else copy.deepcopy(dict(job))
    for change in changes:
        change_key(tree, change)
    return validate_job(tree, "the job"), Path()


class _MadeFiles:
    """The encoded files of one scene."""

    def __init__(self, output: SceneOutput, record: JobRecord) -> None:
        self._data = {file.path: file.data for file in output.files}
        shapes = Shapes(self._shape, record)
        self.mesh, self.samples = shapes.mesh, shapes.samples
        self.patch: Patch = record.job.images.patch

    def _shape(self, path: str) -> bytes:
        if path not in self._data:
            raise FileNotFoundError(path)
        return self._data[path]

    def image(self, scene_id: int, path: str) -> bytes:
        """The bytes of an image."""
        if path not in self._data:
            raise CorruptError(f"{path} was not made")
        return self._data[path]
