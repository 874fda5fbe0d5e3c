"""Image targets of scenes made in memory, judged by their definitions: `python -m tests.judge.targets --scenes 100`.

Every pixel of every view is judged by services/read/independent, from the rows and files that the scene would leave; the floor's
shape, which is in no file, is handed over. Prints one row for each target, and each fault. Ends with 1 where there is one.
With `--job deploy/jobs/captures.yaml` captures are: `--views` photographs of each, of size `--image-scale` 1 at most.
"""

import argparse
import dataclasses
import functools
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import yaml

from schemas.dataset.layout import view_name
from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.job.views import ViewTarget
from schemas.scene.scene import SceneOutput
from services.read.audit import stored_kinds
from services.read.independent.derive import StoredPair
from services.read.independent.poses import check_pair
from services.read.independent.rays import Faces, read_shape
from services.read.independent.targets import Finding
from tests.judge.piles import catalogue_of
from workers.assets.glb import asset_glb
from workers.capture.make_capture import run_capture
from workers.scene.context import WorkerContext, open_worker
from workers.scene.make_scene import Scene, make_scene
from workers.scene.rows import record_scene
from workers.stopwatch import Stopwatch


@dataclass(frozen=True)
class Judged:
    """One scene: findings of all its views, faults of `verify --independent`, why it was refused, and seconds of the judge."""

    scene_id: int
    findings: tuple[Finding, ...] = ()
    faults: tuple[str, ...] = ()
    refused: str = ""
    seconds: float = 0.0


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
    kinds = stored_kinds(job)
    for parent in dict.fromkeys(row["parent_id"] for row in output.rows["views"]):
        views = {
            view_name(str(row["role"]), cast("int | None", row["number"])): row
            for row in output.rows["views"]
            if row["parent_id"] == parent
        }
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
    began, findings, faults = time.process_time(), list[Finding](), list[str]()
    for pair in pairs:
        pair.shapes.update(shapes)
        faults += check_pair(pair)
        findings += pair.findings
    return Judged(scene_id, tuple(findings), tuple(faults), seconds=time.process_time() - began)


def tabulate(judged: Sequence[Judged]) -> str:
    """A row for each target: counts over all views, and the largest error away from edges."""
    head = ("target", "views", "pixels", "near an edge", "another choice stored", "not judged", "wrong", "worst")
    rows = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    every = [one for scene in judged for one in scene.findings]
    for target in dict.fromkeys(one.target for one in every):
        own = [one for one in every if one.target == target]
        counts = [sum(getattr(one, name) for one in own) for name in ("pixels", "edges", "other", "unjudged", "wrong")]
        worst = f"{max(one.worst for one in own):.3g} {own[0].unit}"
        rows.append(f"| {' | '.join([target, *map(str, [len(own), *counts]), worst])} |")
    return "\n".join(rows)


def main() -> int:
    """Make the scenes, tell of each fault, and print the table."""
    given = _arguments()
    document = yaml.safe_load(Path(given.job).read_text())
    document.pop("verso", None)
    asked = list(get_args(ViewTarget))
    if captures := document.get("captures"):
        asked = [name for name in asked if name not in ("albedo", "covisible", "amodal")]
        captures["simulate"] |= {"views": given.views, "image_scale": given.image_scale}
    document["targets"] = {"views": asked, "smooth": given.smooth}
    if given.objects:
        document["objects_per_scene"] = given.objects
    job = Job.model_validate(document).model_dump_json()
    judged = []
    with ProcessPoolExecutor(given.processes) as pool:
        scenes = range(given.first, given.first + given.scenes)
        for one in pool.map(functools.partial(judge_scene, job), scenes):
            judged.append(one)
            told = (
                [f"refused: {one.refused}"] if one.refused else one.faults or [str(f) for f in one.findings if f.wrong]
            )
            print("".join(f"scene {one.scene_id}: {line}\n" for line in told), end="", flush=True)
    print(tabulate(judged))
    made = [one.seconds for one in judged if not one.refused]
    print(f"{len(made)} of {len(judged)} scenes judged, {sum(made) / max(len(made), 1):.1f} s of a processor each")
    return int(any(one.faults for one in judged))


def _arguments() -> argparse.Namespace:
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--job", default="deploy/jobs/pile.yaml")
    ask.add_argument("--scenes", type=int, default=20)
    ask.add_argument("--first", type=int, default=0, help="number of the first scene")
    ask.add_argument("--objects", type=int, nargs=2, help="least and most objects of a scene, instead of the job's")
    ask.add_argument("--views", type=int, default=8, help="photographs of a capture")
    ask.add_argument("--image-scale", type=float, default=0.5, help="size of photographs over the Azure Kinect's")
    ask.add_argument("--smooth", action="store_true", help="normals of shading")
    ask.add_argument("--processes", type=int, default=1)
    return ask.parse_args()


if __name__ == "__main__":
    sys.exit(main())
