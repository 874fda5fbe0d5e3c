"""Image targets of scenes made in memory, judged by their definitions.

Every pixel of every view is judged by services/read/independent, from the rows and files that the scene would leave; the floor's
shape, which is in no file, is handed over.
"""

import dataclasses
import functools
from collections.abc import Iterator

from schemas.job.job import Job
from schemas.scene.scene import SceneOutput
from services.read.audit import stored_kinds
from services.read.dataset_reader import StoredRange
from services.read.independent.derive import StoredPair
from services.read.independent.poses import check_pair
from services.read.independent.rays import read_shape
from services.read.independent.targets import Finding
from tests.judge.piles import catalogue_of
from workers.assets.glb import asset_glb
from workers.scene.context import WorkerContext, open_worker
from workers.scene.make_scene import Scene, make_scene
from workers.scene.rows import record_scene
from workers.stopwatch import Stopwatch


@functools.cache
def context_of(job_json: str) -> WorkerContext:
    """Opened once in each process."""
    return open_worker(Job.model_validate_json(job_json), catalogue_of(job_json))


def stored_pairs(context: WorkerContext, scene: Scene) -> Iterator[StoredPair]:
    """The pairs of a scene as they would be read back."""
    return pairs_of(context.job, record_scene(context, scene, Stopwatch()))


def pairs_of(job: Job, output: SceneOutput) -> Iterator[StoredPair]:
    """The pairs of what a scene or a capture leaves."""
    files, keys = {file.path: file.data for file in output.files}, job.model_dump(mode="json")
    stored = StoredRange(output.scene_id, output.scene_id + 1, (), output.rows)
    for views, objects in stored.pairs(output.scene_id):
        yield StoredPair(keys, output.rows["scenes"][0], views, objects, files.__getitem__, stored_kinds(job))


def judge_scene(job_json: str, scene_id: int) -> tuple[list[Finding], list[str]]:
    """(findings of all views, faults) of a scene that is made and judged with all its targets."""
    context, findings, faults = context_of(job_json), list[Finding](), list[str]()
    scene = make_scene(context, scene_id, Stopwatch())
    floor = read_shape(asset_glb(dataclasses.replace(scene.plan.table.asset, shape=scene.plan.floor)))
    for pair in stored_pairs(context, scene):
        pair.shapes["floor"] = floor
        faults += check_pair(pair)
        findings += pair.findings
    return findings, faults
