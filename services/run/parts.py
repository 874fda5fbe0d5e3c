"""Edge: the convex parts of shapes of libraries, found by the pool before the first scene asks for them."""

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from schemas.environment import cache_folder
from schemas.errors import MachineError, MeshError, plural
from schemas.job.job import Job
from services.run.progress import show_counts
from workers.assets.catalogue import Catalogue, InstanceRef
from workers.pool import Answers, Ended, run_pool

MOST_CUT = 2000
"""Shapes of a job that are cut ahead; of a larger collection, each is cut where a scene first drops it."""

USUAL_FOLDER = cache_folder("parts")


@dataclass(frozen=True)
class Cut:
    """A shape to be cut, by its key and path."""

    catalogue: Catalogue
    ref: InstanceRef
    concavity: float
    key: str
    path: str


def find_parts(job: Job, catalogue: Catalogue, folder: Path | None = USUAL_FOLDER) -> None:
    """Cuts every shape that the job may drop onto another object, and keeps its parts in `folder`, where workers look for them.

    A shape is looked at once for ever. Single objects are left out: over a flat table few ever need parts. Raises MachineError
    where a process is killed.
    """
    if job.captures is not None or job.physics.collision in ("box", "hull") or folder is None:
        return
    if job.objects_per_scene.high == 1 and job.physics.collision != "parts":
        return
    kept = Answers(folder / "cut")
    cuts = [cut for cut in _shapes(job, catalogue) if cut.key not in kept]
    if not cuts or len(cuts) > MOST_CUT:
        return
    deep = []
    with show_counts("meshes", "mesh") as watch:
        for done, (cut, answer) in enumerate(run_pool(cut_shape, cuts, key=lambda cut: cut.key, kept=kept), 1):
            watch("cut into convex parts", done, len(cuts))
            if isinstance(answer, Ended):
                raise MachineError(
                    f"a process that cuts {cut.path} into convex parts ended: {answer.detail}: start again, what is cut stays"
                )
            deep += [cut.path] if answer else []
    if deep:
        print(
            f"verso: the convex parts of {plural(len(deep), 'mesh', 'meshes')}, {deep[0]} first, fill deeper hollows than "
            "physics.concavity says; objects rest on the true meshes all the same",
            file=sys.stderr,
        )


def _shapes(job: Job, catalogue: Catalogue) -> Iterator[Cut]:
    """Every shape of a library that the job may draw as an object."""
    libraries = [(number, library) for number, library in enumerate(catalogue.objects) if library is not None]
    if not libraries:
        return
    from workers.physics.convex_parts import key_of, version_of_parts  # what a job of built-in shapes has no use for

    for (number, library), category in product(libraries, job.categories):
        for index, row in enumerate(library.entries.get(category, ())):
            if row.use:
                ref = catalogue.refer(number, category, index)
                asked = json.dumps([ref.instance_id, row.key, job.physics.concavity])
                key = key_of("parts", version_of_parts(), asked)
                yield Cut(catalogue, ref, job.physics.concavity, key, row.path)


def cut_shape(cut: Cut) -> bytes:
    """In a process of the pool: finds the parts of a shape; `deep` where they fill its hollows deeper than was asked for."""
    from workers.geometry.hull import hull_of
    from workers.geometry.mesh import fills_hull
    from workers.physics.convex_parts import decompose

    try:
        asset = cut.catalogue.load(cut.ref)
    except MeshError:
        return b""  # refused, or changed meanwhile: its scenes say so
    if asset.volume_m3 is not None and fills_hull(asset.volume_m3, hull_of(asset.shape).vertices):
        return b""
    parts, size_m = decompose(asset.shape.mesh, asset.sha256, cut.concavity), max(asset.extents_m)
    return b"deep" if parts.depth_m > cut.concavity * size_m else b""  # deep: twice what is asked for
