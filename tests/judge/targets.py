"""Image targets of scenes made in memory, judged by their definitions.

Every pixel of every view is judged by services/read/independent, from the rows and files that the scene would leave; the floor's
shape, which is in no file, is handed over.
"""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.scene.scene import SceneOutput
from services.read.audit import stored_kinds
from services.read.independent.derive import StoredPair
from services.read.independent.poses import check_pair
from services.read.independent.rays import Faces, read_shape
from services.read.independent.targets import Finding
from workers.assets.catalogue import open_catalogue
from workers.assets.glb import asset_glb
from workers.capture.make_capture import run_capture
from workers.scene.context import Stopwatch, WorkerContext, open_worker
from workers.scene.make_scene import Scene, make_scene
from workers.scene.rows import record_scene


@dataclass(frozen=True)
class Judged:
    """One scene: findings of all its views, faults of `verify --independent`, and why it was refused."""

    scene_id: int
    findings: tuple[Finding, ...] = ()
    faults: tuple[str, ...] = ()
    refused: str = ""


@functools.cache
def context_of(job_json: str) -> WorkerContext:
    """Opened once in each process."""
    job = Job.model_validate_json(job_json)
    return open_worker(job, open_catalogue(job.assets, Path(), tuple(job.categories)))


def stored_pairs(context: WorkerContext, scene: Scene) -> Iterator[StoredPair]:
    """The pairs of a scene as they would be read back."""
    return pairs_of(context.job, record_scene(context, scene, Stopwatch()))


def pairs_of(job: Job, output: SceneOutput) -> Iterator[StoredPair]:
    """The pairs of what a scene or a capture leaves."""
    files, keys = {file.path: file.data for file in output.files}, job.model_dump(mode="json")
    kinds = stored_kinds(job)
    for parent in dict.fromkeys(row["parent_id"] for row in output.rows["views"]):
        views = {str(row["role"]): row for row in output.rows["views"] if row["parent_id"] == parent}
        ids = {row["pose_id"] for row in views.values()}
        objects = [row for row in output.rows["objects"] if row["pose_id"] in ids]
        yield StoredPair(keys, output.rows["scenes"][0], views, objects, files.__getitem__, kinds)


def judge_scene(job_json: str, scene_id: int) -> Judged:
    """Makes a scene, or a capture, and judges all its targets."""
    context, shapes = context_of(job_json), dict[str, Faces]()
    try:
        if context.job.captures is not None:
            pairs = pairs_of(context.job, run_capture(context, scene_id, Stopwatch()))
        else:
            scene = make_scene(context, scene_id, Stopwatch())
            floor = dataclasses.replace(scene.plan.table.asset, shape=scene.plan.floor)
            shapes["floor"], pairs = read_shape(asset_glb(floor)), stored_pairs(context, scene)
    except SceneError as error:
        return Judged(scene_id, refused=error.reason)
    findings, faults = list[Finding](), list[str]()
    for pair in pairs:
        pair.shapes.update(shapes)
        faults += check_pair(pair)
        findings += pair.findings
    return Judged(scene_id, tuple(findings), tuple(faults))
