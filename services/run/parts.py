"""Edge: the convex parts of meshes from outside, found by processes of their own before the first scene asks for them."""

import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from schemas.environment import cache_folder
from schemas.errors import MachineError, MeshError
from schemas.job.assets import ProceduralSource
from schemas.job.job import Job
from services.run.progress import ProgressLine
from workers.assets.catalogue import Catalogue, InstanceRef

MOST_PROCESSES = 8
"""Processes that cut meshes at once: each holds one mesh."""

MOST_TOLD = 3
"""Meshes that are named one by one."""


USUAL_FOLDER = cache_folder("parts")


def find_parts(job: Job, catalogue: Catalogue, folder: Path | None = USUAL_FOLDER) -> None:
    """Cuts every mesh that the job may drop onto another object, and keeps its parts in `folder`, where workers look for them.

    A mesh is looked at once for ever. Single objects are left out: over a flat table few ever need parts. Raises MachineError
    where a process is killed.
    """
    if job.captures is not None or job.physics.collision in ("box", "hull") or folder is None:
        return
    if job.objects_per_scene.high == 1 and job.physics.collision != "parts":
        return
    refs = list(_meshes(job, catalogue))
    if not refs:
        return
    # what a job of built-in shapes has no use for
    from workers.assets.external.verdicts import Verdicts, verdict_key
    from workers.physics.convex_parts import key_of, version_of_parts

    kept, keys = Verdicts(folder), {}
    for ref in refs:
        settings, listing = catalogue.settings(ref), catalogue.objects[ref.source]
        assert listing is not None and not isinstance(settings, ProceduralSource)
        entry = listing.entries[ref.category][ref.index]
        asked = verdict_key(settings, job.assets, ref.category, entry)
        key = key_of("parts", version_of_parts(), repr(job.physics.concavity), asked)
        if key not in kept:
            keys[ref] = key, listing.folder, entry.files[0].path
    line, deep = ProgressLine(len(keys), "meshes cut into convex parts", "mesh"), list[str]()
    count = max(1, min(len(os.sched_getaffinity(0)), MOST_PROCESSES, len(keys)))
    with ProcessPoolExecutor(count, multiprocessing.get_context("spawn")) as pool:
        cuts = {pool.submit(_cut, catalogue, ref, job.physics.concavity): ref for ref in keys}
        for done, cut in enumerate(as_completed(cuts), 1):
            key, root, path = keys[cuts[cut]]
            line.show(done, name=path)
            try:
                told = cut.result()
            except BrokenProcessPool as error:
                raise MachineError(
                    "a process that cuts meshes into convex parts was killed from outside, perhaps for want of memory: "
                    "start again, what is cut stays"
                ) from error
            kept.put([(key, None)], root)
            if told:
                deep.append(f"{path}: {told}")
    line.close()
    if deep:
        more = f"; and {len(deep) - MOST_TOLD} more" if len(deep) > MOST_TOLD else ""
        told = (
            f"verso: convex parts fill deeper hollows than physics.concavity says: {'; '.join(deep[:MOST_TOLD])}{more}"
        )
        print(f"{told}. Objects rest on the true meshes all the same", file=sys.stderr)


def _meshes(job: Job, catalogue: Catalogue) -> Iterator[InstanceRef]:
    """Every instance from a file that the job may draw as an object."""
    for number, listing in enumerate(catalogue.objects):
        for category in job.categories:
            if listing is None:
                continue
            refused = listing.refused.get(category, frozenset())
            for index in range(len(listing.entries.get(category, ()))):
                if index not in refused:
                    yield catalogue.refer(number, category, index)


def _cut(catalogue: Catalogue, ref: InstanceRef, concavity: float) -> str:
    """In a process of its own: finds the parts of a mesh; what is to be told of them, empty where nothing is."""
    from workers.geometry.hull import hull_of
    from workers.geometry.mesh import fills_hull
    from workers.physics.convex_parts import decompose

    try:
        asset = catalogue.load(ref)
    except MeshError:
        return ""  # changed since it was checked: its scenes say so
    if asset.volume_m3 is not None and fills_hull(asset.volume_m3, hull_of(asset.shape).vertices):
        return ""
    parts, size_m = decompose(asset.shape.mesh, asset.sha256, concavity), max(asset.extents_m)
    deep = parts.depth_m > concavity * size_m  # twice what is asked for
    return f"{len(parts.clouds)} parts, {parts.depth_m * 1e3:.1f} mm of {size_m * 1e3:.0f} mm" if deep else ""
